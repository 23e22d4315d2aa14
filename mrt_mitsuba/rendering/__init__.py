"""A render: options, plan, passes, tracing, memory, progress."""
