"""Identified loads, kept on disk: an identification that was once made need not be repeated.

A file holds what `identify_load` found for one scenario. Its name is a hash of everything that this
depends on: the scenario of the identification with arm, tool, sensor, motion, rates and seed; the
sources and models of this package; the libraries that compute, and the processor. A change of any
of these, an edit of the sources too, is another name; what is found under a name is what would be
identified now, bit by bit.

The files lie in the user's cache folder (on Linux ~/.cache/drake_teleop), or in the folder that
DRAKE_TELEOP_CACHE_DIR names. They may be removed at any time.
"""

from __future__ import annotations

import dataclasses
import os
import platform
from contextlib import suppress
from dataclasses import dataclass
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.progress import Stage
from drake_teleop.common.resources import models_dir
from drake_teleop.common.version import __version__
from drake_teleop.common.writing import CannotWrite, make_folder, whole_file
from drake_teleop.lab.identification import identification_scenario, identify_load, slave_arm
from drake_teleop.load.contact.noise_floor import NoiseFloor
from drake_teleop.load.identification import Identification
from drake_teleop.station.scenario import Scenario, check_scenario

CACHE_VARIABLE = "DRAKE_TELEOP_CACHE_DIR"
"""The environment variable that names another folder than the user's cache folder."""
LARGEST_NUMBER = 2000
"""How many files are kept, of 5 kB each; the oldest are removed."""

_LIBRARIES = ("drake", "numpy", "scipy", "numba")


@dataclass(frozen=True, eq=False, repr=False)
class IdentifiedLoad:
    """What an identification before a run found.

    Attributes:
        identification: the load.
        noise_floor: of the wrench that it leaves in free motion, if the scenario detects contact.
        from_cache: whether it had been found before.
    """

    identification: Identification
    noise_floor: NoiseFloor | None
    from_cache: bool

    def __repr__(self) -> str:
        return repr(self.identification)

    @property
    def estimate(self) -> NDArray[np.float64]:
        """(16,) [offsets; phi], Eq. (7), as a station takes it."""
        return np.concatenate([self.identification.offsets, self.identification.phi])


def identified_load(
    scenario: Scenario,
    progress: bool | Stage = True,
    *,
    fresh: bool = False,
    folder: Path | None = None,
) -> IdentifiedLoad:
    """The load of a scenario that does not learn it while it runs: kept, or identified and kept.

    Args:
        scenario: that is to be run.
        progress: as for `identify_load`.
        fresh: whether to identify anew although it was kept.
        folder: of the files, instead of the user's.

    Raises:
        DrakeTeleopError: as `identify_load`. A file that cannot be read is made anew; that one
            cannot be written is no error.
    """
    check_scenario(scenario)
    # Another seed: the noise of the run must not be the one that was learnt from.
    before = identification_scenario(scenario, scenario.simulation.seed + 1)
    detects = scenario.contact_detection is not None
    path = (folder or cache_folder()) / f"load-{_key(before, detects)}.npz"
    if not fresh and (kept := read_load(path)) is not None:
        return kept
    found = identify_load(before, progress)
    floor = found.noise_floor(slave_arm(scenario)) if detects else None
    load = IdentifiedLoad(found.identification, floor, from_cache=False)
    with suppress(CannotWrite, OSError):  # a full disk: it is identified again next time
        write_load(path, load)
    return load


def cache_folder() -> Path:
    """Where identified loads are kept if no folder is given."""
    from platformdirs import user_cache_path

    return Path(os.environ.get(CACHE_VARIABLE) or user_cache_path("drake_teleop", appauthor=False))


def _sources(package: Path, models: Path) -> str:
    """A hash of the package's sources and of the models."""
    files = {path.relative_to(package).as_posix(): path for path in package.rglob("*.py")}
    files |= {path.relative_to(models).as_posix(): path for path in models.rglob("*.*")}
    contents = (f"{name} {sha256(files[name].read_bytes()).hexdigest()}" for name in sorted(files))
    return sha256("\n".join(contents).encode()).hexdigest()


# When this is imported: later the sources may have been edited, while the old ones go on running.
_SOURCES = _sources(Path(__file__).parents[1], models_dir())


def _key(before: Scenario, detects: bool) -> str:
    from llvmlite.binding import get_host_cpu_name

    computed_by = [f"{name} {version(name)}" for name in _LIBRARIES]
    computed_by += [f"python {platform.python_version()}", get_host_cpu_name(), _SOURCES]
    models = [sha256(path.read_bytes()).hexdigest() for path in before.slave.files()]
    what = (__version__, dataclasses.asdict(before), detects, computed_by, models)
    return sha256(repr(what).encode()).hexdigest()


def write_load(path: Path, load: IdentifiedLoad) -> None:
    """Writes it, complete or not at all, whoever else does the same now."""
    columns = {
        f"{name}.{field.name}": getattr(part, field.name)
        for name, part in (("load", load.identification), ("floor", load.noise_floor))
        if part is not None
        for field in dataclasses.fields(part)
    }
    make_folder(path.parent)
    with whole_file(path, shared=True) as unfinished, unfinished.open("wb") as file:
        np.savez(file, **columns)
    files = [(each.stat().st_mtime_ns, each) for each in path.parent.glob("load-*")]
    for _, old in sorted(files)[:-LARGEST_NUMBER]:
        old.unlink(missing_ok=True)


def read_load(path: Path) -> IdentifiedLoad | None:
    """What `_write` wrote; None if there is nothing that can be read. The file has checksums."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            columns = {name: archive[name] for name in archive.files}
        values: dict[str, dict[str, Any]] = {"load": {}, "floor": {}}
        for name, value in columns.items():
            part, _, field = name.partition(".")
            values[part][field] = value if value.ndim else value.item()
        floor = NoiseFloor(**values["floor"]) if values["floor"] else None
        return IdentifiedLoad(Identification(**values["load"]), floor, from_cache=True)
    except Exception:  # what a damaged file leads to, zipfile and numpy do not say
        return None
