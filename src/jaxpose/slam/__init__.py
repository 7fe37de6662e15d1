"""Dense RGB-D(-inertial) SLAM on a continuous trajectory.

`init`, `step` and `finish` take frames one by one, as a camera gives them; `run` tracks a recording.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
