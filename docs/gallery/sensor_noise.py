"""
Noise of wrist sensors
======================

Allan deviation of the force of commercial sensors: the standard deviation of a mean over some time.
Where a curve rises, a longer mean is less accurate: measure the offset again (tare) by then.
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
