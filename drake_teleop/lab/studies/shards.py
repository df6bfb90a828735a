"""Shards of a study: disjoint groups of its chunks for computers that share only a file system.

Shard K/N runs every N-th chunk into the folder `shards/K-of-N` of the study.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import replace_file_on_success
from drake_teleop.lab.studies.processes import Chunk
from drake_teleop.lab.studies.store import Store, write_or_check_identity

_MAX_SHARDS_IN_MESSAGE = 20


class Shard(NamedTuple):
    """One of `total` shards of a study, with its `number` from 1."""

    number: int
    total: int

    def folder(self, out: Path) -> Path:
        return out / "shards" / f"{self.number}-of-{self.total}"

    def chunks(self, chunks: Sequence[Chunk]) -> list[Chunk]:
        if self.total > len(chunks):
            what = f"the study has only {len(chunks)} chunks of runs (one for each shard)"
            remedy = f"give at most {len(chunks)} shards"
            raise DrakeTeleopError(what, where=f"shard {self.number}/{self.total}", remedy=remedy)
        return list(chunks[self.number - 1 :: self.total])


def parse_shard(text: str) -> Shard:
    found = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text, re.ASCII)
    if not found or not 1 <= int(found[1]) <= int(found[2]):
        what = f"{text!r} is not K/N with 1 <= K <= N"
        raise DrakeTeleopError(what, where="shard", remedy="give one, such as 3/8")
    return Shard(int(found[1]), int(found[2]))


def merge_shards(out: Path, store: Store, identity: dict[str, Any], chunks: list[Chunk]) -> None:
    """Link the result files of all shards in `out` into its table; raise if runs are missing."""
    names = (re.fullmatch(r"([1-9]\d*)-of-([1-9]\d*)", p.name) for p in out.glob("shards/*"))
    shards = [Shard(int(name[1]), int(name[2])) for name in names if name]
    if not shards:
        raise DrakeTeleopError("has no shards", where=str(out), remedy="run study --shard K/N")
    for shard in sorted(shards):
        folder = shard.folder(out)
        write_or_check_identity(folder, identity)
        for part in Store(folder / "runs.parquet").part_files():
            _link_or_copy_file(part, store.folder / part.name, store.folder)
    store.remove_damaged_parts()
    finished = store.first_runs_of_finished_chunks()
    missing = [k for k, chunk in enumerate(chunks) if chunk[0]["run"] not in finished]
    if missing:
        count = max(shard.total for shard in shards)
        numbers = sorted({k % count + 1 for k in missing})
        listed = ",".join(map(str, numbers[:_MAX_SHARDS_IN_MESSAGE]))
        more = ",..." if len(numbers) > _MAX_SHARDS_IN_MESSAGE else ""
        runs = sum(len(chunks[k]) for k in missing)
        what = f"{runs} of {sum(map(len, chunks))} runs are missing"
        remedy = f"run shards {listed}{more} of {count} again, then merge"
        raise DrakeTeleopError(what, where=str(out), remedy=remedy)


def _link_or_copy_file(part: Path, path: Path, temporary_base: Path) -> None:
    if path.exists():
        return
    with replace_file_on_success(path, temporary_base=temporary_base) as temporary:
        try:
            os.link(part, temporary)
        except OSError:  # a file system without links
            shutil.copyfile(part, temporary)
