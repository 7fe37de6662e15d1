"""Photographs with poses."""
