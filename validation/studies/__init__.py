"""The studies of ``mrt-validate``, one module or package each."""
