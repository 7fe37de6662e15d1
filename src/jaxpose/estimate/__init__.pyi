from .factors import Factor as Factor
from .factors import position_factor as position_factor
from .posterior import NoiseLevels as NoiseLevels
from .posterior import Posterior as Posterior
from .posterior import Sensors as Sensors
from .smoothing import QUANTITIES as QUANTITIES
from .smoothing import Quantity as Quantity
from .smoothing import smooth as smooth
