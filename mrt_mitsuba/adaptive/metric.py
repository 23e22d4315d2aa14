"""Metrics of a picture's error: of linear values, relative to them, or of values as a screen shows them.

A metric encodes values; the error of a picture is the RMSE of its encoded values. To first order, the squared
error of a pixel is that of its linear values times the squared slope of the encoding, by which rays are
allocated.
"""

from __future__ import annotations

import numpy as np

OFFSET = 0.1  # to which relative errors are limited in the dark: its square is the 0.01 of ``rel_mse``


class Metric:
    """The error of linear values."""

    name = "linear"
    reference: float | None = None  #: value to which a target in percent refers; None: the mean luminance

    def encode(self, values: np.ndarray) -> np.ndarray:
        """Values whose differences are errors."""
        return values

    def squared_errors(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Unbiased estimate, to first order, of the squared error of the mean of two independent pictures.

        NaNs are masked by the caller.
        """
        with np.errstate(invalid="ignore", over="ignore"):
            return np.square(self.encode(first) - self.encode(second), dtype=np.float64) / 4

    def weights(self, values: np.ndarray, deviation: np.ndarray) -> np.ndarray:
        """Factors from squared linear errors to errors in this metric, for values of this standard deviation.

        They are squared slopes of chords, so that values which are hardly known do not decide much.
        """
        half = np.maximum(deviation, np.float32(1e-3) * (abs(values) + np.float32(1e-3)))
        with np.errstate(invalid="ignore", over="ignore"):
            return np.square((self.encode(values + half) - self.encode(values - half)) / (2 * half))

    def rmse(self, picture: np.ndarray, reference: np.ndarray) -> float:
        """Error of a picture, given the true one."""
        difference = self.encode(np.float64(picture)) - self.encode(np.float64(reference))
        return float(np.sqrt(np.square(difference).mean()))


class LinearMetric(Metric):
    """The error of linear values, whose weights are 1."""

    def weights(self, values: np.ndarray, deviation: np.ndarray) -> np.ndarray:
        return np.ones_like(values)


class RelativeMetric(Metric):
    """The error relative to the true value x, or more exactly to √(x² + 0.01): the root of ``rel_mse``."""

    name = "relative"
    reference = 1.0
    whole = "the true values"

    def encode(self, values: np.ndarray) -> np.ndarray:
        return np.arcsinh(values / np.float32(OFFSET))  # its slope is 1/√(x² + 0.01)

    def rmse(self, picture: np.ndarray, reference: np.ndarray) -> float:
        square = np.square(np.float64(picture) - reference) / (
            np.square(reference, dtype=np.float64) + OFFSET**2
        )
        return float(np.sqrt(square.mean()))


class DisplayMetric(Metric):
    """The error of sRGB values, clipped to [0, 1]; a grey level is 1/255."""

    name = "display"
    reference = 1.0

    def encode(self, values: np.ndarray) -> np.ndarray:
        clipped = np.clip(values, 0, 1)
        return np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055)


LINEAR = LinearMetric()
METRICS: dict[str, Metric] = {metric.name: metric for metric in (LINEAR, RelativeMetric(), DisplayMetric())}
