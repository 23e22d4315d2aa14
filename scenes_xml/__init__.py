"""The scenes as Mitsuba XML files, written from the dicts of mrt_mitsuba.scenes."""
