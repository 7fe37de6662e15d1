"""A room made on the fly, for tests and for a first run without data."""

from jaxpose.datasets.synthetic.room_renderer import RoomConfig, room

__all__ = ["RoomConfig", "room"]
