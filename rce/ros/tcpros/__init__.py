"""TCPROS, the ROS 1 transport of topics and services: headers, frames, connections."""
