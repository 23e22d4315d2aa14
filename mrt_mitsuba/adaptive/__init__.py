"""Adaptive sampling to an error target: samplers, estimation of the error, allocation of samples, rounds."""
