"""JSON objects of robots to serialized ROS messages and back."""

from rce_robot.converters.converter import Converter, Converters
from rce_robot.converters.custom import CustomConverter, load_custom_converters
from rce_robot.exceptions import ConversionError

__all__ = ["ConversionError", "Converter", "Converters", "CustomConverter", "load_custom_converters"]
