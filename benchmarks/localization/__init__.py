"""Accuracy and speed of the localization."""
