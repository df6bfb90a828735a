"""
Errors in a log description
===========================

The sample log's description gets four errors, one at a time. Each of them contradicts the laws of
motion (a wrong sign gives a negative mass), and the finding names the line that fixes it.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

from drake_teleop.logs.processing import check_log
from drake_teleop.logs.sample import sample_log_command

folder = Path(tempfile.mkdtemp())
sample_log_command(folder, quiet=True)
good = (folder / "free.yaml").read_text()
spoilt = {
    "as it is": good,
    "sign: -1 left out": good.replace("sign: -1", "sign: 1"),
    "unit: deg left out": good.replace(", unit: deg", ""),
    "unit: mm left out": good.replace(", unit: mm", ""),
    "x and y exchanged": good.replace("[Fx, Fy", "[Fy, Fx").replace("[Tx, Ty", "[Ty, Tx"),
}
figure, axes = plt.subplots(figsize=(7.5, 3))
for k, (name, text) in enumerate(spoilt.items()):
    (folder / "try.yaml").write_text(text)
    found = check_log(folder / "try.yaml")
    axes.barh(k, 100 * found.fit.unexplained, color="C0" if name == "as it is" else "C1")
    print(f"{name}: {[finding.message for finding in found.findings] or 'nothing to say'}")
axes.set(yticks=range(len(spoilt)), yticklabels=spoilt, xscale="log")
axes.set(xlabel="of the wrench, what no load explains [%]")
axes.invert_yaxis()
