"""Recordings: one reader a format, and synthetic ones."""
