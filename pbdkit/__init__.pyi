# The public names of pbdkit, and where each comes from; __init__.py reads them here.

from pbdkit import errors as errors
from pbdkit import plugin as plugin
from pbdkit import testing as testing
from pbdkit.api import (
    analyse as analyse,
)
from pbdkit.api import (
    fit as fit,
)
from pbdkit.api import (
    fit_strength as fit_strength,
)
from pbdkit.api import (
    identify as identify,
)
from pbdkit.api import (
    load as load,
)
from pbdkit.api import (
    rerun as rerun,
)
from pbdkit.api import (
    resume as resume,
)
from pbdkit.api import (
    run as run,
)
from pbdkit.api import (
    sweep as sweep,
)
from pbdkit.errors import (
    DivergedError as DivergedError,
)
from pbdkit.errors import (
    ExperimentError as ExperimentError,
)
from pbdkit.errors import (
    PbdkitError as PbdkitError,
)
from pbdkit.errors import (
    PbdkitWarning as PbdkitWarning,
)
from pbdkit.errors import (
    PluginError as PluginError,
)
from pbdkit.errors import (
    StorageError as StorageError,
)
from pbdkit.io.open import open as open
from pbdkit.model.experiment import Experiment as Experiment
from pbdkit.plugin import (
    Diagnostic as Diagnostic,
)
from pbdkit.plugin import (
    FollowerRule as FollowerRule,
)
from pbdkit.plugin import (
    FractureModel as FractureModel,
)
from pbdkit.plugin import (
    FramePolicy as FramePolicy,
)
from pbdkit.plugin import (
    Lattice as Lattice,
)
from pbdkit.plugin import (
    NeighbourMetric as NeighbourMetric,
)
from pbdkit.plugin import (
    ParticleOperation as ParticleOperation,
)
from pbdkit.plugin import (
    hookimpl as hookimpl,
)
from pbdkit.simulation import Simulation as Simulation
from pbdkit.sweeps.combine import concat as concat
from pbdkit.web import live as live
from pbdkit.web.report import report as report

__version__: str
__all__: list[str]
