"""What a study varies, and by which design: the file, and the points that follow from it."""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError, meant
from drake_teleop.common.fields import settings
from drake_teleop.common.quantities import check_ranges, choice, plain, quantity
from drake_teleop.lab.studies.measures import MEASURES, default_measures

Array = NDArray[np.float64]
Value: TypeAlias = float | str | bool | list[float]
Values: TypeAlias = dict[str, Value]
"""The factors' values of one point of the design, by field."""

MANY_RUNS = 10**5
"""So many are days or weeks: somebody has to say that they are meant."""
MOST_RUNS = 10**6
"""The design of so many needs 1 GB."""

# Among so many points (a power of two) an adaptive design chooses the next ones.
_CANDIDATES = 1024


@settings
@dataclass
class Factor:
    """A field of the scenario that the study varies: over a list of what it takes, or a range."""

    field: str = plain("", "`block.field`, as it stands in a scenario file")
    values: list[float] = plain([], "the numbers that it takes")
    words: list[str] = plain([], "the words that it takes, in place of numbers")
    flags: list[bool] = plain([], "likewise")
    vectors: list[list[float]] = plain([], "likewise")
    low: float | None = plain(None, "where its range begins, in place of a list")
    high: float | None = plain(None, "where its range ends")
    levels: int = quantity(3, "1", 2, 1000, "values between low and high in a factorial design")

    def listed(self) -> Sequence[Value]:
        """The values of a factorial design."""
        if self.low is not None and self.high is not None:
            return [float(value) for value in np.linspace(self.low, self.high, self.levels)]
        return self.values or self.words or self.flags or self.vectors

    def at(self, share: float) -> Value:
        """The value at a share from 0 up to 1 of the way through the range or the list."""
        if self.low is not None and self.high is not None:
            return self.low + share * (self.high - self.low)
        listed = self.listed()
        return listed[int(share * len(listed))]

    def coordinates(self, value: Value) -> list[float]:
        """Where a value is in the space of the design: numbers from 0 to 1.

        Numbers by their size; of words, flags and vectors each has an axis of its own, because
        none of them is between two others.
        """
        if self.low is not None and self.high is not None:
            low, high = self.low, self.high
        elif self.values:
            low, high = min(self.values), max(self.values)
        else:
            return [float(value == other) for other in self.listed()]
        assert isinstance(value, (int, float))
        return [(value - low) / (high - low) if high > low else 0.0]

    def check(self, where: str) -> None:
        """Checks all that can be checked without the scenario.

        Raises:
            DrakeTeleopError: naming `where`.
        """
        ranged = [self.low is not None, self.high is not None]
        lists = (self.values, self.words, self.flags, self.vectors)
        if [*map(bool, lists), any(ranged)].count(True) != 1 or any(ranged) != all(ranged):
            raise DrakeTeleopError(
                "what it varies over is not clear",
                where=where,
                remedy="give either values, or words, or flags, or vectors, or both low and high",
            )
        numbers = [*self.values, *itertools.chain(*self.vectors)]
        numbers += [self.high - self.low] if self.low is not None and self.high is not None else []
        if not all(map(math.isfinite, numbers)):
            raise DrakeTeleopError("its numbers, or their range, are not finite", where=where)
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise DrakeTeleopError(
                f"the range ends at {self.high:g}, before it begins", where=f"{where}.high"
            )
        listed = self.listed()
        if any(value in listed[:index] for index, value in enumerate(listed)):
            raise DrakeTeleopError("a value stands there twice", where=where)


@settings
@dataclass
class Study:
    """What a study varies, by which design, and what it measures."""

    description: str = plain("", "what the study is about")
    scenario: str = plain(
        "contact_transition",
        "name of a shipped one, or a YAML file; its path is relative to the study's file",
    )
    factors: list[Factor] = plain([], "the fields that it varies")
    design: str = choice(
        "factorial",
        ("factorial", "sobol", "adaptive"),
        "every combination of the values, scrambled Sobol points, or a search for the best point",
    )
    samples: int = quantity(64, "1", 1, 2**20, "points of a Sobol (a power of two) or adaptive one")
    objective: str = plain(
        "", "the measure whose mean over the repeats an adaptive design makes small"
    )
    batch: int = quantity(8, "1", 1, 2**10, "points that an adaptive design chooses at once")
    repeats: int = quantity(1, "1", 1, 1e6, "runs of each point, each with a seed of its own")
    seed: int = quantity(0, "1", 0, 1e9, "of the Sobol points, and of the first repeat")
    measures: list[str] = plain(default_measures(), "what it measures of each run")
    force_threshold: float = quantity(1.0, "N", 0.0, 1e3, "of time_above_force_s")

    def check(self, where: str) -> None:
        """Checks all that can be checked without the scenario.

        Raises:
            DrakeTeleopError: naming `where` and the field.
        """
        check_ranges(self, where)
        for name in self.measures:
            if name not in MEASURES:
                raise DrakeTeleopError(
                    f"there is no measure '{name}'",
                    where=f"{where}:measures",
                    remedy=meant(name, MEASURES, f"choose among {', '.join(MEASURES)}"),
                )
        for index, factor in enumerate(self.factors):
            factor.check(f"{where}:factors[{index}]")
        fields = [factor.field for factor in self.factors]
        for index, name in enumerate(fields):
            place = f"{where}:factors[{index}].field"
            if name in fields[:index]:
                raise DrakeTeleopError(f"{name} is varied twice", where=place)
            if name == "simulation.seed":
                raise DrakeTeleopError(
                    "the seed is no factor", where=place, remedy="set repeats and seed"
                )
        if not self.factors:
            raise DrakeTeleopError("nothing is varied", where=f"{where}:factors")
        if self.design == "sobol" and self.samples & (self.samples - 1):
            raise DrakeTeleopError(
                f"{self.samples} Sobol points are not balanced",
                where=f"{where}:samples",
                remedy="give a power of two",
            )
        if (self.design == "adaptive") != (self.objective in self.measures):
            raise DrakeTeleopError(
                f"'{self.objective}' is no objective for a design that is {self.design}",
                where=f"{where}:objective",
                remedy="an adaptive design takes one of the study's measures, the others none",
            )

    def size(self) -> int:
        """The number of points."""
        if self.design == "factorial":
            return math.prod(len(factor.listed()) for factor in self.factors)
        return self.samples

    def check_size(self, where: str, yes: bool | Callable[[str], bool]) -> None:
        """Refuses a study that is too large, before there is anything as large as it.

        Args:
            where: its place, for messages.
            yes: whether many runs are meant; or what answers, if there are many.

        Raises:
            DrakeTeleopError: for more than `MOST_RUNS`, or for more than `MANY_RUNS` that are not
                meant, saying how many there are.
        """
        runs = self.size() * self.repeats
        what = f"{runs:,} runs" if runs < 10**15 else f"10^{math.log10(runs):.1f} runs"
        if runs > MOST_RUNS:
            remedy = f"give fewer values or repeats: a study has {MOST_RUNS:,} runs at most"
            raise DrakeTeleopError(f"{what} are too many", where=where, remedy=remedy)
        if runs <= MANY_RUNS or yes is True:
            return
        if yes is False or not yes(f"{where}: {what}. Begin?"):
            remedy = "--yes (in Python: yes=True) says that they are meant"
            raise DrakeTeleopError(f"{what} are many", where=where, remedy=remedy)

    def points(self) -> list[Values]:
        """The design: the factors' values at each of its points; of an adaptive one, the first."""
        if self.design == "factorial":
            names = [factor.field for factor in self.factors]
            combinations = itertools.product(*(factor.listed() for factor in self.factors))
            return [dict(zip(names, values, strict=True)) for values in combinations]
        if self.design == "sobol":
            return self._sobol(self.samples, self.seed)
        # Enough to begin with: a few for each factor.
        first = max(self.batch, 2 * (len(self.factors) + 1))
        return self._sobol(1 << (first - 1).bit_length(), self.seed)[: self.samples]

    def next_points(self, points: Sequence[Values], objective: Array) -> list[Values]:
        """The points that an adaptive design tries next; none when there are enough, or no others.

        Args:
            points: that were tried, n of them.
            objective: (n,) at each; nan if it has none.
        """
        count = min(self.batch, self.samples - len(points))
        if self.design != "adaptive" or count <= 0:
            return []
        from drake_teleop.lab.studies.adaptive import propose

        # Others in each batch, or the points would all be on one grid.
        tried = {str(point) for point in points}
        drawn = self._sobol(_CANDIDATES, self.seed + len(points))
        candidates = list(
            {str(point): point for point in drawn if str(point) not in tried}.values()
        )
        if len(candidates) <= count:
            return candidates
        chosen = propose(self._places(points), objective, self._places(candidates), count)
        return [candidates[index] for index in chosen]

    def rows(self, points: Sequence[Values], first: int = 0) -> list[dict[str, Any]]:
        """The runs of some points, without their measures; `first` is the first one's number.

        All points have the same seeds: what differs between them is not the noise. Every second
        seed is left to the identification that goes before a run.
        """
        order = itertools.product(enumerate(points, first), range(self.repeats))
        return [
            {"run": run, "point": point, "repeat": repeat, "seed": self.seed + 2 * repeat} | values
            for run, ((point, values), repeat) in enumerate(order, first * self.repeats)
        ]

    def _sobol(self, count: int, seed: int) -> list[Values]:
        from scipy.stats import qmc

        # A generator as `seed`: the keyword of every version, with the meaning of the new one.
        sobol = qmc.Sobol(len(self.factors), seed=np.random.default_rng(seed))
        shares = sobol.random_base2(count.bit_length() - 1)
        return [
            {factor.field: factor.at(u) for factor, u in zip(self.factors, point, strict=True)}
            for point in shares.tolist()
        ]

    def _places(self, points: Sequence[Values]) -> Array:
        """(n, d) coordinates of points."""
        rows = [
            list(itertools.chain(*(f.coordinates(point[f.field]) for f in self.factors)))
            for point in points
        ]
        return np.array(rows)
