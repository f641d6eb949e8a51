"""What the sensor does to depth: measured in every capture, assumed where it cannot be (docs/method.md)."""

from tubepose.sensor.measuring import measure_noise
from tubepose.sensor.noise import SensorNoise, prior_noise

__all__ = ["SensorNoise", "measure_noise", "prior_noise"]
