"""Independent answers: a float64 tracer and exact values."""
