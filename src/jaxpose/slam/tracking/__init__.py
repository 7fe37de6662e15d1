"""Tracking: predict, register, relocalise."""
