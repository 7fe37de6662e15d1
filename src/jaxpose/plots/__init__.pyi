from . import evaluation as evaluation
from . import events as events
from . import nerf as nerf
from . import planar as planar
from . import preview as preview
from . import slam as slam
