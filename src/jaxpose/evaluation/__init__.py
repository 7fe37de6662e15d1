"""Errors of trajectories and quality of images."""
