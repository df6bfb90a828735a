"""Search words, and the section that the site's search lists first for each.

They are here and not in the pages, because other tools read the Markdown too.
"""

from __future__ import annotations

from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.transforms import SphinxTransform

#: Search words by page and id of the section.
KEYWORDS = {
    "analysis": {
        "what-each-criterion-means": "Llewellyn, Raisbeck, absolute stability, Z-width, Nyquist",
        "how-far-from-the-limit": "delay margin, gain margin, phase margin",
    },
    "choose": {
        "sigma-gamma-eta": "sigma, gamma, eta",
        "a-method-of-passivity": "passivity, wave variables, TDPA",
        "rates": "sampling rate",
    },
    "concepts": {
        "frames": "frame, monogram notation",
        "signs": "sign, specific force",
        "what-a-verdict-means": "verdict, identified, weakly",
    },
    "delay": {"the-network": "network, jitter, packet loss", "the-safe-state": "safe state"},
    "detection": {"the-threshold": "contact detection, threshold"},
    "logs": {
        "where-the-pose-is-and-how-noisy": "TCP, flange, tracker",
        "where-the-imu-is": "IMU, accelerometer",
        "from-an-excitation-to-the-load": "excitation",
    },
    "log-description": {
        "bags": "ROS, rosbag, MCAP",
        "fields": "unit, sign, axes, Euler angles",
    },
    "robot": {
        "the-load-in-the-robot-s-format": "Franka, UR, URScript, payload",
        "the-wrench-without-the-tool-live": "compensate, gravity compensation",
        "beside-a-robot": "UR RTDE, ATI NetFT, OnRobot, ROS 2 rmw_zenoh, Franka",
    },
    "sensor": {"the-presets": "ATI, JR3, Bota, Robotiq, OnRobot, sensor noise"},
    "station": {
        "another-haptic-device": "haptic device, omega.6, Falcon, Phantom",
        "a-side-of-your-own": "LeafSystem",
        "ports": "port",
    },
    "cluster": {"a-batch-script": "SLURM, HPC, array job, shard, merge"},
    "studies": {"how-long-it-takes": "Dask, cluster"},
    "wrench-not-zero": {"a-robot-s-log-after-eliminate": "tare, offset, drift"},
}


class Keywords(SphinxTransform):
    """Transform that adds the search words to the index, before Sphinx collects it."""

    default_priority = 500

    def apply(self, **_options: Any) -> None:
        """Add the search words of the page.

        Raises:
            ExtensionError: for a section that the page does not have.
        """
        sections = {
            name: section
            for section in self.document.findall(nodes.section)
            for name in section["ids"]
        }
        for name, words in KEYWORDS.get(self.env.docname, {}).items():
            if name not in sections:
                raise ExtensionError(f"{self.env.docname} has no section {name}: keywords.py")
            entries = [("single", word, name, "main", None) for word in words.split(", ")]
            sections[name].insert(1, addnodes.index(entries=entries))


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the transform."""
    app.add_transform(Keywords)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
