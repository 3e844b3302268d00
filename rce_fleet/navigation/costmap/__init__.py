"""Layered costmaps with the constants, the cost function and the parameters of ROS's costmap_2d. Pure."""
