"""Volumes: folders of users on this machine that outlive their containers."""
