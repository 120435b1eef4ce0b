"""The DeepMind Control Suite on dm_control's own models, as dm_control and as MuJoCo Playground have it."""

from ksim_rl.suites.dm_control.models import DmControlModel
from ksim_rl.suites.dm_control.quantities import (
    BodyAxes,
    Control,
    Distance,
    Factor,
    GeneralizedVelocity,
    Offset,
    Readings,
    ToleranceProduct,
)
from ksim_rl.suites.dm_control.starts import DrawStart, StartFromBank
from ksim_rl.suites.dm_control.targets import BoxTarget, RingTarget
from ksim_rl.suites.dm_control.tasks import TASKS
