"""
What a wrist sensor leaves, by its noise
========================================

The Allan deviation of the force of sensors as they are sold: how sure a mean over some time is.
Where a curve turns up, averaging for longer makes it worse: take the offset (tare) anew by then.
"""

import matplotlib.pyplot as plt
import numpy as np
from sensor_noise import predicted_allan_deviation  # docs/_ext/sensor_noise.py

from drake_teleop.station.sensor.presets import PRESETS
from drake_teleop.station.sensor.sensor_chain import without_parts

rates = {"jr3_85m35a3": 8000, "ati_gamma_imu": 698, "bota_sensone": 800, "robotiq_ft300": 100}
figure, axes = plt.subplots(figsize=(7, 4))
for name, rate in rates.items():
    samples = np.unique(np.geomspace(1, 100 * rate, 40).astype(int))
    config = without_parts(PRESETS[name], "drift")
    deviation = predicted_allan_deviation(config, samples, 1 / rate)
    axes.loglog(samples / rate, deviation[0], label=f"{name}, {rate} Hz")
axes.set(xlabel="averaging time [s]", ylabel="Allan deviation of $f_x$ [N]")
axes.legend()
