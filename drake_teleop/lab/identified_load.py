"""Cache of identified loads in the user's cache folder or in DRAKE_TELEOP_CACHE_DIR."""

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

from drake_teleop.common.files import CannotWrite, make_folder, models_dir, replace_file_on_success
from drake_teleop.common.numeric import Array
from drake_teleop.common.progress import StartStage
from drake_teleop.common.version import __version__
from drake_teleop.lab.identification import identification_scenario, identify_load, slave_arm
from drake_teleop.load.contact.noise_floor import NoiseFloor
from drake_teleop.load.identification import Identification
from drake_teleop.load.online.recursive_tls import METHODS
from drake_teleop.station.scenario import Scenario, check_scenario

CACHE_ENV_NAME = "DRAKE_TELEOP_CACHE_DIR"
"""Environment variable with the cache folder."""
MAX_CACHED_FILES = 2000
"""Maximum number of cached files; each has 5 kB."""


@dataclass(frozen=True, eq=False, repr=False)
class IdentifiedLoad:
    """Load identified before a run; `noise_floor` is None without contact detection."""

    identification: Identification
    noise_floor: NoiseFloor | None
    from_cache: bool

    def __repr__(self) -> str:
        return repr(self.identification)

    @property
    def estimate(self) -> Array:
        """Estimate (16,) of Eq. (7): sensor offsets [N, N m], then phi."""
        return np.concatenate([self.identification.offsets, self.identification.phi])


def identified_load(
    scenario: Scenario,
    progress: bool | StartStage = True,
    *,
    fresh: bool = False,
    folder: Path | None = None,
) -> IdentifiedLoad:
    """Return the load of a scenario from the cache, or identify and cache it.

    `fresh` ignores the cached load. A damaged or unwritable cache file raises no error.
    """
    check_scenario(scenario)
    # Another seed: noise of identification and run must be independent.
    before = identification_scenario(scenario, scenario.simulation.seed + 1)
    detects = scenario.contact_detection is not None
    path = (folder or cache_folder()) / f"load-{_identified_load_cache_key(before, detects)}.npz"
    # A registered estimator may have changed since.
    fresh = fresh or before.load_estimator.method not in METHODS.shipped
    if not fresh and (cached := read_cached_load(path)) is not None:
        return cached
    found = identify_load(before, progress)
    floor = found.noise_floor(slave_arm(scenario)) if detects else None
    load = IdentifiedLoad(found.identification, floor, from_cache=False)
    with suppress(CannotWrite, OSError):  # next time the load is identified again
        write_cached_load(path, load)
    return load


def cache_folder() -> Path:
    from platformdirs import user_cache_path

    return Path(os.environ.get(CACHE_ENV_NAME) or user_cache_path("drake_teleop", appauthor=False))


def _hash_source_files(package: Path, models: Path) -> str:
    files = {path.relative_to(package).as_posix(): path for path in package.rglob("*.py")}
    files |= {path.relative_to(models).as_posix(): path for path in models.rglob("*.*")}
    contents = (f"{name} {sha256(files[name].read_bytes()).hexdigest()}" for name in sorted(files))
    return sha256("\n".join(contents).encode()).hexdigest()


# Hashed at import: the sources may be edited while this process runs the old ones.
_SOURCE_FILES_HASH = _hash_source_files(Path(__file__).parents[1], models_dir())


def _identified_load_cache_key(identification: Scenario, with_noise_floor: bool) -> str:
    from llvmlite.binding import get_host_cpu_name

    computed_by = [f"{name} {version(name)}" for name in ("drake", "numpy", "scipy", "numba")]
    computed_by += [f"python {platform.python_version()}", get_host_cpu_name(), _SOURCE_FILES_HASH]
    models = [sha256(path.read_bytes()).hexdigest() for path in identification.slave.model_files()]
    what = (__version__, dataclasses.asdict(identification), with_noise_floor, computed_by, models)
    return sha256(repr(what).encode()).hexdigest()


def write_cached_load(path: Path, load: IdentifiedLoad) -> None:
    """Write a cache file atomically; remove the oldest files above `MAX_CACHED_FILES`."""
    columns = {
        f"{name}.{field.name}": getattr(part, field.name)
        for name, part in (("load", load.identification), ("floor", load.noise_floor))
        if part is not None
        for field in dataclasses.fields(part)
    }
    make_folder(path.parent)
    with replace_file_on_success(path, shared=True) as unfinished, unfinished.open("wb") as file:
        np.savez(file, **columns)
    files = [(each.stat().st_mtime_ns, each) for each in path.parent.glob("load-*")]
    for _, old in sorted(files)[:-MAX_CACHED_FILES]:
        old.unlink(missing_ok=True)


def read_cached_load(path: Path) -> IdentifiedLoad | None:
    """Return the load in a cache file; None if the file is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            columns = {name: archive[name] for name in archive.files}
        values: dict[str, dict[str, Any]] = {"load": {}, "floor": {}}
        for name, value in columns.items():
            part, _, field = name.partition(".")
            values[part][field] = value if value.ndim else value.item()
        floor = NoiseFloor(**values["floor"]) if values["floor"] else None
        return IdentifiedLoad(Identification(**values["load"]), floor, from_cache=True)
    except Exception:  # zipfile and NumPy do not document the errors of damaged files
        return None
