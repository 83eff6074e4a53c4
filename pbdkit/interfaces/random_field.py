"""Random fields: numbers that differ from place to place by chance, near places alike."""

from __future__ import annotations

from collections.abc import Mapping, Set
from typing import Annotated, Any, Self

import numpy as np
from pydantic import ConfigDict, Field, PrivateAttr, RootModel, model_validator

from pbdkit.interfaces.component import Strict
from pbdkit.interfaces.units import LENGTH
from pbdkit.interfaces.varying import Floats, Gridded, Held, Varying, as_varying

MOST_DRAWN = 2**22
"""So many values are drawn, which takes minutes."""
NEAR = 1e-9
"""Of the distance between places: so far they differ by rounding."""


class Drawn(Strict):
    """Values over a grid, and the numbers and the seed from which they were drawn."""

    seed: Annotated[int, Field(ge=0)]
    mean: float
    scatter: float
    correlation_length: float
    x: Any
    y: Any
    values: Any

    _grid: Gridded = PrivateAttr()

    @model_validator(mode="after")
    def _gridded(self) -> Self:
        grid = as_varying({"x": self.x, "y": self.y, "values": self.values})
        assert isinstance(grid, Gridded)
        self._grid = grid
        return self

    @property
    def grid(self) -> Gridded:
        """The values."""
        return self._grid

    def answers(self, asked: Mapping[str, float], x: Floats, y: Floats) -> bool:
        """Whether they were drawn from these numbers, for these places."""
        if any(getattr(self, name) != number for name, number in asked.items()):
            return False
        pairs = (self._grid.x, x), (self._grid.y, y)
        return all(
            len(known) == len(wanted) and np.allclose(known, wanted, NEAR, NEAR * np.ptp(wanted))
            for known, wanted in pairs
        )


class RandomField(Strict, Varying):
    """A field with a mean and a standard deviation of `scatter` times the mean, drawn from the
    experiment's seed: lognormal, so that all values are positive and both are exact.

    Z = mean · exp(σ g - σ²/2) with σ² = ln(1 + scatter²), where g is a standard Gaussian field with
    the covariance exp(-(r/correlation_length)²) over the distance r. g is a sum of waves with
    random wave vectors, by the randomisation method (Heße et al., Environ. Model. Softw. 55 (2014)
    32-48) of GSTools: a function of the place alone, whatever the spacing and the body.
    """

    mean: Annotated[float, Field(gt=0.0, le=1e100)]
    scatter: Annotated[float, Field(gt=0.0, lt=1.0)]
    correlation_length: Annotated[float, Field(gt=1e-100, le=1e100), LENGTH]
    drawn: Drawn | None = None
    """What came of it; drawn anew where it is no answer to what is asked now."""

    @property
    def samples(self) -> dict[str, float]:
        """Those of the values; the mean as long as there are none."""
        return self.drawn.grid.samples if self.drawn else {"the mean": self.mean}

    def at(self, x: Floats, y: Floats, held: Held, reach: float = 0.0) -> Floats:
        """The values; the mean as long as there are none."""
        if self.drawn is None:
            return np.full(np.shape(x), self.mean)
        return self.drawn.grid.at(x, y, held, reach)

    def written(self) -> dict[str, Any]:
        """What was asked, and what came of it."""
        return self.model_dump(mode="json", exclude_none=True)

    def drawn_at(self, x: Floats, y: Floats, seed: int, stream: str) -> RandomField:
        """With its values over a grid of places. All fields of one stream come of the same g, each
        with its own length.

        Raises ValueError for too many places, and without GSTools.
        """
        asked = self.model_dump(exclude={"drawn"}) | {"seed": seed}
        if self.drawn and self.drawn.answers(asked, x, y):
            return self
        sigma = np.sqrt(np.log1p(self.scatter**2))
        g = _standard(x, y, self.correlation_length, seed, stream)
        found = Gridded(x, y, self.mean * np.exp(sigma * g - sigma**2 / 2))
        drawn = Drawn.model_validate(asked | found.written())
        return self.model_copy(update={"drawn": drawn})


def _standard(x: Floats, y: Floats, length: float, seed: int, stream: str) -> Floats:
    """g at (x, y)."""
    if len(x) * len(y) > MOST_DRAWN:
        raise ValueError(
            f"{len(x) * len(y)} values are more than the {MOST_DRAWN} that are drawn; draw it at "
            "fewer places, and give it as {file: NAME.nc, variable: NAME}"
        )
    try:
        import gstools
    except ImportError:
        raise ValueError(
            "random fields are drawn with GSTools: pip install 'pbdkit[random]'"
        ) from None
    model = gstools.Gaussian(dim=2, len_scale=length, rescale=1.0)
    own = np.random.SeedSequence(seed, spawn_key=tuple(f"{stream} field".encode()))
    waves = gstools.SRF(model, seed=int(own.generate_state(1)[0]))
    return np.asarray(waves.structured((x, y), store=False))


class _RandomFields(RootModel[dict[str, RandomField]]):
    """By name, so that what is wrong has its place."""

    model_config = ConfigDict(defer_build=True)


def random_fields(data: Mapping[str, Any], names: Set[str], context: Any) -> dict[str, RandomField]:
    """The parameters of these names that are maps of a random field. Raises ValidationError."""
    asked = {name: data[name] for name in names & data.keys() if _asks(data[name])}
    return _RandomFields.model_validate(asked, context=context).root if asked else {}


def _asks(given: Any) -> bool:
    keys = given.keys() if isinstance(given, dict) else set[str]()
    return "otherwise" not in keys and not keys.isdisjoint(RandomField.model_fields)
