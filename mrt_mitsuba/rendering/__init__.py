"""A render: settings, plan, passes, tracing, progress."""
