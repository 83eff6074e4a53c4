# The public names of pbdkit, and where each comes from; __init__.py reads them here.

from pbdkit import errors as errors, plugin as plugin, testing as testing
from pbdkit.api import (
    analyse as analyse,
    fit as fit,
    fit_strength as fit_strength,
    identify as identify,
    load as load,
    rerun as rerun,
    resume as resume,
    run as run,
    sweep as sweep,
)
from pbdkit.errors import (
    DivergedError as DivergedError,
    ExperimentError as ExperimentError,
    PbdkitError as PbdkitError,
    PbdkitWarning as PbdkitWarning,
    PluginError as PluginError,
    StorageError as StorageError,
)
from pbdkit.io.open import open as open
from pbdkit.model.experiment import Experiment as Experiment
from pbdkit.plugin import (
    Diagnostic as Diagnostic,
    FollowerRule as FollowerRule,
    FractureModel as FractureModel,
    FramePolicy as FramePolicy,
    Lattice as Lattice,
    NeighbourMetric as NeighbourMetric,
    ParticleOperation as ParticleOperation,
    hookimpl as hookimpl,
)
from pbdkit.simulation import Simulation as Simulation
from pbdkit.sweeps.combine import concat as concat
from pbdkit.web import live as live
from pbdkit.web.report import report as report

__version__: str
__all__: list[str]
