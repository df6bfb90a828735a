"""Content of a study file, and its design points."""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from drake_teleop.common.config import check_all_field_values, choice, plain, quantity, settings
from drake_teleop.common.errors import DrakeTeleopError, suggest_name
from drake_teleop.common.numeric import Array
from drake_teleop.lab.studies.measures import MEASURES, default_measures

FactorValue: TypeAlias = float | str | bool | list[float]
FactorValues: TypeAlias = dict[str, FactorValue]
"""Values of the factors at one point, by field."""

MAX_RUNS_WITHOUT_CONSENT = 10**5
"""Number of runs above which a study takes days or weeks and requires consent."""
MAX_RUNS = 10**6
"""Maximum number of runs; their design needs 1 GB of memory."""


@settings
@dataclass
class Factor:
    """Scenario field that the study varies."""

    field: str = plain("", "`block.field` of the scenario file that this factor varies")
    values: list[float] = plain([], "numbers that the field takes")
    words: list[str] = plain([], "words that the field takes, instead of `values`")
    flags: list[bool] = plain([], "[false, true] for a flag, instead of `values`")
    vectors: list[list[float]] = plain([], "vectors, instead of `values`")
    low: float | None = plain(None, "lowest value of a range, instead of `values`")
    high: float | None = plain(None, "highest value of the range")
    levels: int = quantity(3, "1", 2, 1000, "number of values from low to high (factorial)")

    def level_values(self) -> Sequence[FactorValue]:
        """Return the listed values, or `levels` evenly spaced numbers from `low` to `high`."""
        if self.low is not None and self.high is not None:
            return [float(value) for value in np.linspace(self.low, self.high, self.levels)]
        return list(map(float, self.values)) or self.words or self.flags or self.vectors

    def value_at_share(self, share: float) -> FactorValue:
        """Return low + share * (high - low), or the listed value at this share of the list."""
        if self.low is not None and self.high is not None:
            return self.low + share * (self.high - self.low)
        listed = self.level_values()
        return listed[int(share * len(listed))]

    def coordinates(self, value: FactorValue) -> list[float]:
        """Return [share of the range] of a number, or an indicator 0 or 1 for each listed value."""
        if self.low is not None and self.high is not None:
            low, high = self.low, self.high
        elif self.values:
            low, high = min(self.values), max(self.values)
        else:
            return [float(value == other) for other in self.level_values()]
        assert isinstance(value, (int, float))
        return [(value - low) / (high - low) if high > low else 0.0]

    def check(self, where: str) -> None:
        kinds = ["values", "words", "flags", "vectors", "low", "high"]
        given = [name for name in kinds if getattr(self, name) not in (None, [])]
        if given != kinds[4:] and (len(given) != 1 or given[0] in kinds[4:]):
            what = f"has {' and '.join(given) or 'no values'}"
            remedy = "give one of values, words, flags, vectors, or both low and high"
            raise DrakeTeleopError(what, where=where, remedy=remedy)
        numbers = [*self.values, *itertools.chain(*self.vectors)]
        numbers += [self.high - self.low] if self.low is not None and self.high is not None else []
        if wrong := [number for number in numbers if not math.isfinite(number)]:
            what = f"the value or range {wrong[0]:g} is not finite"
            raise DrakeTeleopError(what, where=where, remedy="replace NaN and infinity")
        if self.low is not None and self.high is not None and not self.low < self.high:
            what = f"{self.high:g} is not above low, {self.low:g}"
            raise DrakeTeleopError(what, where=f"{where}.high", remedy="raise high or lower low")
        listed = self.level_values()
        if repeated := [value for k, value in enumerate(listed) if value in listed[:k]]:
            remedy = "list each value once"
            raise DrakeTeleopError(f"lists {repeated[0]} twice", where=where, remedy=remedy)


@settings
@dataclass
class Study:
    """Content of a study file: factors, design and measures."""

    description: str = plain("", "purpose of the study")
    scenario: str = plain(
        "contact_transition",
        "name of a shipped scenario, or a YAML file, relative to the study file",
    )
    factors: list[Factor] = plain([], "varied fields")
    design: str = choice(
        "factorial",
        ("factorial", "sobol", "adaptive"),
        "all combinations of the values, scrambled Sobol points, or a search for the best point",
    )
    samples: int = quantity(
        64, "1", 1, 2**20, "number of points of a Sobol design (a power of two) or adaptive design"
    )
    objective: str = plain("", "measure whose mean over the repeats an adaptive design minimises")
    batch: int = quantity(8, "1", 1, 2**10, "number of points in one batch of an adaptive design")
    repeats: int = quantity(1, "1", 1, 1e6, "number of runs of each point, with different seeds")
    seed: int = quantity(0, "1", 0, 1e9, "seed of the Sobol points and of the first repeat")
    measures: list[str] = plain(default_measures(), "measures of each run")
    force_threshold: float = quantity(1.0, "N", 0.0, 1e3, "threshold of time_above_force_s")

    def check(self, where: str) -> None:
        check_all_field_values(self, where)
        if unknown := [name for name in self.measures if name not in MEASURES]:
            remedy = suggest_name(unknown[0], MEASURES, f"choose among {', '.join(MEASURES)}")
            what = f"there is no measure '{unknown[0]}'"
            raise DrakeTeleopError(what, where=f"{where}:measures", remedy=remedy)
        fields = [factor.field for factor in self.factors]
        for index, (name, factor) in enumerate(zip(fields, self.factors, strict=True)):
            factor.check(f"{where}:factors[{index}]")
            place = f"{where}:factors[{index}].field"
            if name in fields[:index]:
                remedy = "remove one factor"
                raise DrakeTeleopError(f"{name} is varied twice", where=place, remedy=remedy)
            if name == "simulation.seed":
                remedy = "set repeats and seed"
                raise DrakeTeleopError("the seed cannot be a factor", where=place, remedy=remedy)
        if not self.factors:
            what = "is empty (a study varies at least one field)"
            raise DrakeTeleopError(what, where=f"{where}:factors", remedy="add a factor")
        if self.design == "sobol" and self.samples & (self.samples - 1):
            what = f"{self.samples} Sobol points are not balanced (only a power of two is)"
            raise DrakeTeleopError(what, where=f"{where}:samples", remedy="give a power of two")
        if (self.design == "adaptive") != (self.objective in self.measures):
            what = f"'{self.objective}' cannot be the objective of design '{self.design}'"
            remedy = "give one of the measures for an adaptive design, no objective for others"
            raise DrakeTeleopError(what, where=f"{where}:objective", remedy=remedy)

    def num_points(self) -> int:
        if self.design == "factorial":
            return math.prod(len(factor.level_values()) for factor in self.factors)
        return self.samples

    def check_num_runs(self, where: str, yes: bool | Callable[[str], bool]) -> None:
        """Raise DrakeTeleopError for too many runs, or above 100,000 runs without consent.

        `yes` is the consent, or a function that asks the user a question.
        """
        runs = self.num_points() * self.repeats
        count = f"{runs:,} runs" if runs < 10**15 else f"10^{math.log10(runs):.1f} runs"
        if runs > MAX_RUNS:
            what = f"{count} are too many (at most {MAX_RUNS:,})"
            raise DrakeTeleopError(what, where=where, remedy="give fewer values or repeats")
        if runs <= MAX_RUNS_WITHOUT_CONSENT or yes is True:
            return
        if yes is False or not yes(f"{where}: {count}. Begin?"):
            remedy = "confirm them by --yes (in Python: yes=True)"
            raise DrakeTeleopError(f"{count} need your consent", where=where, remedy=remedy)

    def points(self) -> list[FactorValues]:
        """Return all points (field -> value), or the first points of an adaptive design."""
        if self.design == "factorial":
            names = [factor.field for factor in self.factors]
            combinations = itertools.product(*(factor.level_values() for factor in self.factors))
            return [dict(zip(names, values, strict=True)) for values in combinations]
        if self.design == "sobol":
            return self._draw_sobol_points(self.samples, self.seed)
        # At least two points for each factor.
        first = max(self.batch, 2 * (len(self.factors) + 1))
        return self._draw_sobol_points(1 << (first - 1).bit_length(), self.seed)[: self.samples]

    def next_points(self, points: Sequence[FactorValues], objective: Array) -> list[FactorValues]:
        """Return the next points of an adaptive design; an empty list at its end."""
        count = min(self.batch, self.samples - len(points))
        if self.design != "adaptive" or count <= 0:
            return []
        from drake_teleop.lab.studies.adaptive import propose_points

        # New candidates for each batch, so that the points are not on one grid.
        tried = {str(point) for point in points}
        drawn = self._draw_sobol_points(1024, self.seed + len(points))
        candidates = list({str(p): p for p in drawn if str(p) not in tried}.values())
        if len(candidates) <= count:
            return candidates
        places, others = self._point_coordinates(points), self._point_coordinates(candidates)
        chosen = propose_points(places, objective, others, count)
        return [candidates[index] for index in chosen]

    def rows(self, points: Sequence[FactorValues], first: int = 0) -> list[dict[str, Any]]:
        """Return a row per run: its number, point (from `first`), repeat, seed, factor values."""
        order = itertools.product(enumerate(points, first), range(self.repeats))
        return [
            {"run": run, "point": point, "repeat": repeat, "seed": self.seed + 2 * repeat} | values
            for run, ((point, values), repeat) in enumerate(order, first * self.repeats)
        ]

    def _draw_sobol_points(self, count: int, seed: int) -> list[FactorValues]:
        from scipy.stats import qmc

        # All SciPy versions accept a generator as `seed`.
        sobol = qmc.Sobol(len(self.factors), seed=np.random.default_rng(seed))
        shares = sobol.random_base2(count.bit_length() - 1)
        return [
            {f.field: f.value_at_share(u) for f, u in zip(self.factors, point, strict=True)}
            for point in shares.tolist()
        ]

    def _point_coordinates(self, points: Sequence[FactorValues]) -> Array:
        values = [[f.coordinates(point[f.field]) for f in self.factors] for point in points]
        return np.array([np.concatenate(row) for row in values])
