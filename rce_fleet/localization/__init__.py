"""Localization on a known map: an adaptive particle filter (AMCL). Pure: neither ROS nor the engine."""
