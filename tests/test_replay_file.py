"""3D replay: number of frames, and escaped texts."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from drake_teleop.station.replay_file import DisplayedNumber, ReplayFile, frame_times


@pytest.mark.parametrize(
    ("seconds", "slow_motion", "frames"),
    [(0.8, 10, 401), (6.0, 1, 301), (5.0, 2, 501), (39.0, 1, 1951), (36000.0, 1, 2001)],
)
def test_replay_lasts_at_least_six_seconds_with_limited_frames(seconds, slow_motion, frames):
    times, chosen = frame_times(1.0, 1.0 + seconds)
    assert (chosen, len(times)) == (slow_motion, frames)
    assert (times[0], times[-1]) == (1.0, 1.0 + seconds)


def test_replay_of_one_instant():
    times, _ = frame_times(1.0, 1.0)
    np.testing.assert_array_equal(times, [1.0, 1.0])


@pytest.mark.slow
def test_page_escapes_all_texts_and_numbers(tmp_path):
    reading = DisplayedNumber("<b>", "N", np.array([np.nan, 1.23456, 20.0]), "#0072B2")
    film = ReplayFile("</script><b>&", np.array([0.0, 0.5, 1.0]), 1.0, [reading], notes=("<i>",))
    frames = []
    film.write(tmp_path / "film.html", lambda meshcat: lambda replay_time, k: frames.append(k))
    assert frames == [0, 1, 2]
    page = (tmp_path / "film.html").read_text(encoding="utf-8")
    player = page[page.index('<div id="player">') :]
    assert player.count("</script>") == 1
    assert "<h1>&lt;/script&gt;&lt;b&gt;&amp;</h1>" in player
    assert "<i>" not in player
    assert 'name="viewport" content="width=device-width' in page  # otherwise it is 980 pixels wide
    found = json.loads(re.search(r"const film = (.*);\n", player)[1])
    assert found["title"] == "</script><b>&"
    assert found["readings"][0]["values"] == [None, 1.235, 20.0]
