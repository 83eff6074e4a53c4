"""The experiment: a validated description of a scene, and of what to do with it."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Annotated, Any, Self

from pydantic import (
    AfterValidator,
    Field,
    PrivateAttr,
    SerializeAsAny,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
    model_validator,
)

from pbdkit.errors import ExperimentError, PluginError
from pbdkit.experiment.body_algebra import AnyBody
from pbdkit.experiment.initial import AnyInitial
from pbdkit.experiment.leaders import LeaderGroup
from pbdkit.experiment.obstacles import Obstacle
from pbdkit.experiment.parts import brief, fault, open_part, report
from pbdkit.experiment.record import Record
from pbdkit.experiment.solvers import AnySolver, Stepping
from pbdkit.experiment.source import Source
from pbdkit.interfaces import (
    INTERFACES,
    Component,
    Diagnostic,
    FollowerRule,
    FractureModel,
    FramePolicy,
    Lattice,
    NeighbourMetric,
    RenewsParticles,
    Softens,
)
from pbdkit.interfaces.component import Strict
from pbdkit.registry.registry import Registry


def _valid_name(name: str) -> str:
    words = name.split("/")
    if len(name) > 200 or ".." in name or not all(re.fullmatch(_WORD, word) for word in words):
        raise fault(
            "may hold letters, digits, '.', '_', '-' and '/', no '..', and no part between slashes "
            f"that is empty or begins with a dot; got {brief(name)}"
        )
    return name


def _known_version(version: int) -> int:
    if version != 1:
        raise fault(f"this pbdkit reads version 1, got {brief(version)}")
    return version


_WORD = r"[A-Za-z0-9_-][A-Za-z0-9._-]*"
Name = Annotated[
    str, AfterValidator(_valid_name), Field(json_schema_extra={"pattern": f"^{_WORD}(/{_WORD})*$"})
]
Version = Annotated[int, AfterValidator(_known_version), Field(json_schema_extra={"const": 1})]
AnyDiagnostic = Annotated[SerializeAsAny[Diagnostic], open_part(Diagnostic)]


def _default(part: str) -> Any:
    # As in a file, so that it is resolved like one, and `--set` can start from it.
    return Field(default={"type": part})


class Experiment(Strict):
    """A scene and what to do with it, checked as a whole: the same from a file, dict or objects.

    Raises ExperimentError, which names the field and the remedy, for anything that is not right,
    and PluginError where a part is asked of a distribution that is missing or broken.
    """

    version: Version = 1
    name: Name
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    lattice: Annotated[SerializeAsAny[Lattice], open_part(Lattice)]
    body: AnyBody
    neighbours: Annotated[SerializeAsAny[NeighbourMetric], open_part(NeighbourMetric)] = _default(
        "coordination"
    )
    rule: Annotated[SerializeAsAny[FollowerRule], open_part(FollowerRule)]
    frame: Annotated[SerializeAsAny[FramePolicy], open_part(FramePolicy)] = _default("mean")
    fracture: Annotated[SerializeAsAny[FractureModel], open_part(FractureModel)] = _default("none")
    initial: AnyInitial = _default("reference")
    leaders: Annotated[tuple[LeaderGroup, ...], Field(strict=False)] = ()
    obstacles: Annotated[tuple[Obstacle, ...], Field(strict=False)] = ()
    steps: Annotated[int, Field(ge=1, lt=2**62)]
    record: Record = Field(default_factory=Record)
    diagnostics: Annotated[tuple[AnyDiagnostic, ...], Field(strict=False)] = ()
    solver: AnySolver = _default("stepping")

    @model_validator(mode="after")
    def _together(self) -> Self:
        last, settles = max(self.record.at or (0,)), self.stepping.settle is not None
        anew, jumps = self.neighbours.nearness() is not None, not self.solver.makes_steps
        remembers = isinstance(self.rule, RenewsParticles)
        softens = isinstance(self.fracture, Softens)
        clashes = [
            ("record", last > self.steps, f"step {last} is beyond the run's {self.steps}"),
            ("fracture", anew and self.fracture.can_break,
             "bonds cannot break where neighbours are re-evaluated: there are no lasting bonds; "
             "set neighbours.reevaluate: false or fracture: {type: none}"),
            ("solver", anew and jumps,
             "where neighbours are re-evaluated nothing tells where the steps lead; "
             "set neighbours.reevaluate: false or solver: {type: stepping}"),
            ("solver", anew and settles,
             "where neighbours are re-evaluated no distance from equilibrium is known; "
             "set neighbours.reevaluate: false, or leave solver.settle out"),
            ("solver", settles and (remembers or softens),
             f"'{(self.rule if remembers else self.fracture).type}' remembers, so that no distance "
             "from equilibrium is known; leave solver.settle out"),
            ("solver", jumps and remembers,
             f"the rule '{self.rule.type}' remembers, so that where the steps lead depends on "
             "all of them; take solver: {type: stepping}"),
        ]  # fmt: skip
        for key, clash, text in clashes:
            if clash:
                raise fault(text, key=key)
        return self

    @property
    def recording(self) -> Record:
        """What is recorded: of an equilibrium, the start and the end."""
        if self.solver.makes_steps:
            return self.record
        return self.record.model_copy(update={"at": (0, self.steps)})

    @property
    def stepping(self) -> Stepping:
        """How a step of it is made, whatever the solver."""
        return self.solver.stepping

    def records(self, step: int) -> bool:
        """Whether that step is recorded."""
        return self.recording.keeps(step, self.steps)

    def next_wanted(self, step: int) -> int:
        """The next step after `step` of which something is recorded."""
        if any(d.every_step and not d.at_end for d in self.diagnostics):
            return step + 1
        return self.recording.next_after(step, self.steps)

    _source: Source = PrivateAttr(default_factory=Source)
    _registry: Registry = PrivateAttr()

    def __init__(self, **parts: Any) -> None:
        self._validate(parts, Registry(), Source())

    @model_serializer(mode="wrap")
    def _with_origins(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Types that several distributions offer keep the name of theirs."""
        found: dict[str, Any] = serialize(self)
        *single, many = (found[field] for field in INTERFACES)
        for part, dumped in zip(self.components(), [*single, *many], strict=True):
            dumped["type"] = self._registry.name_of(part)
        return found

    @classmethod
    def build(cls, source: Source, components: Iterable[type[Component]] = ()) -> Self:
        """The experiment of a source, with components handed over besides the installed ones."""
        experiment = cls.__new__(cls)
        experiment._validate(source.data, Registry(components), source)
        return experiment

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        """The parts that a file may leave out, as it would write them."""
        fields = cls.model_fields.items()
        return {name: f.default for name, f in fields if isinstance(f.default, dict)}

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Experiment) and self.__dict__ == other.__dict__

    def __hash__(self) -> int:
        return hash(tuple(self.__dict__.values()))

    @property
    def shows_bonds(self) -> bool:
        """Whether the dataset has a table of bonds: fracture or a diagnostic uses it."""
        return self.fracture.can_break or any("bonds" in d.needs for d in self.diagnostics)

    def components(self) -> list[Component]:
        """Every part of an open interface."""
        *single, many = (getattr(self, field) for field in INTERFACES)
        return [*single, *many]

    def distributions(self) -> dict[str, str]:
        """The distributions that the parts come from, with their versions."""
        return self._registry.versions(self.components())

    def located(self, error: ExperimentError) -> ExperimentError:
        """The error with the place of its field in the file."""
        return ExperimentError(self._source.message(error.where, str(error)), error.where)

    def _validate(self, parts: dict[str, Any], registry: Registry, source: Source) -> None:
        try:
            self.__pydantic_validator__.validate_python(
                parts, self_instance=self, context={"registry": registry}
            )
        except ValidationError as error:
            raise report(error, source) from None
        except PluginError as error:
            raise PluginError(source.message(error.where, str(error)), error.where) from None
        self._registry, self._source = registry, source
