"""Poses and angles in the plane. Pure: numpy only."""
