"""The example client for OpenHaptics, built against stubs of HDAPI."""

from __future__ import annotations

import shutil
import socket
import subprocess
from pathlib import Path

import numpy as np
import pytest

from drake_teleop.live.device_guard import DeviceGuard, DeviceLimits
from drake_teleop.live.device_packets import (
    CLUTCH_OPEN_FLAG,
    ForceCommand,
    pack_force,
    unpack_state,
)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler"),
]
STUBS = Path(__file__).with_name("openhaptics")
CLIENT = Path(__file__).parents[2] / "drake_teleop" / "live" / "openhaptics_client.c"


def built(source: Path, program: Path) -> Path:
    words = ["cc", "-std=gnu11", "-O1", "-Wall", "-Wextra", "-Werror", "-Wno-unused-function"]
    words += [f"-I{STUBS}", f"-I{CLIENT.parent}", str(source), "-o", str(program)]
    subprocess.run([*words, "-lm", "-lpthread"], check=True)
    return program


def test_guard_equals_that_of_the_package(tmp_path):
    """Inputs are slow and fast displacements, silences, NaN and forces beyond the limits."""
    random, guard = np.random.default_rng(2), DeviceGuard(DeviceLimits(force=3.3))
    x = np.cumsum(random.normal(size=(3000, 3)) * random.choice([1e-6, 3e-4], (3000, 1)), axis=0)
    commands = random.normal(size=(3000, 3)).cumsum(axis=0) * 0.1
    commands[::97] = np.nan
    ages = random.uniform(0.0, 0.03, 3000)
    ages[500:560], ages[900:910], ages[1500] = 0.06, np.inf, 0.05
    periods = random.choice([1e-3, 9e-4, 4e-3], 3000)
    rows = np.column_stack([x, commands, ages, periods])
    program = built(STUBS / "guard.c", tmp_path / "guard")
    text = "\n".join(" ".join(map(repr, row)) for row in rows.tolist())
    answer = subprocess.run([program], input=text, capture_output=True, text=True, check=True)
    found = np.array([line.split() for line in answer.stdout.splitlines()], float)
    expected = [guard.limit_wrench(r[:3], (*r[3:6], 0, 0, 0), r[6], r[7])[:3] for r in rows]
    assert guard.num_reduced_forces > 100 and np.linalg.norm(expected, axis=1).max() > 3.0
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_client_sends_the_pose_and_displays_the_force(tmp_path):
    program = built(CLIENT, tmp_path / "client")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", 0))
        station.settimeout(20.0)
        words = [program, str(station.getsockname()[1]), "0.5"]
        with subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as process:
            for _ in range(300):
                packet, sender = station.recvfrom(1000)
                state = unpack_state(packet)
                command = ForceCommand(state.number, state.t, (0.3, 0.2, 0.1, 0.0, 0.0, 0.0))
                station.sendto(pack_force(command), sender)
            output, _ = process.communicate("\n")
        assert process.returncode == 0
    # HDAPI (10, 20, 30) mm: z is B's x, x its y, y its z. A rotation about up is one about B's z.
    np.testing.assert_allclose(state.position, [0.03, 0.01, 0.02], atol=1e-12)
    np.testing.assert_allclose(
        state.quaternion_wxyz, [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-12
    )
    assert state.flags == CLUTCH_OPEN_FLAG and 0.0 < state.force_age_s < 1.0
    lines = [line.split() for line in output.splitlines() if line.startswith("force ")]
    assert {line[1] for line in lines} == {"1"}, "within a frame"
    forces = np.array([line[2:] for line in lines], float)
    assert not forces[0].any()
    near = np.abs(forces - [0.2, 0.1, 0.3]).max(axis=1)
    assert near.min() < 1e-9 and np.linalg.norm(forces, axis=1).max() <= 0.5
    assert "forces up to 0.50 N" in output


def test_missing_port_is_a_message(tmp_path):
    program = built(CLIENT, tmp_path / "client")
    answer = subprocess.run([program], capture_output=True, text=True, check=False)
    assert answer.returncode == 2 and answer.stderr.startswith("usage: ")
