"""Packages that users bring: uploads, and storage of their contents."""
