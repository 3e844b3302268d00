"""The output of a container's nodes: standard output, standard error and ROS's log, in bounded files."""
