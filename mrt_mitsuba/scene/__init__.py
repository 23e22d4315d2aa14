"""Scenes: the model, the report's scenes, OBJ files, and their translation to Mitsuba."""
