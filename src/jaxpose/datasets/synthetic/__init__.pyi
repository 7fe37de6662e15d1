from . import event_orbit as event_orbit
from . import orbit as orbit
from . import pose_noise as pose_noise
from .room_renderer import RoomConfig as RoomConfig
from .room_renderer import room as room
