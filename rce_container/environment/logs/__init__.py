"""What a container's nodes say: standard output, standard error and ROS's log, in bounded files."""
