"""What studies are made of: bounds, the report page, image tests, timing, probes."""
