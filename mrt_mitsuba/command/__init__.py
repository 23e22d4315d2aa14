"""The ``mrt`` command."""
