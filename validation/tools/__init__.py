"""Parts of studies: bounds, the report page, image tests, timing, probes."""
