"""The module of the entry point in the group ``mitsuba``, by which Mitsuba 3.10 finds plugins by itself.

It imports the module when a variant is set for the first time and reloads it after each switch. Mitsuba 3.9
knows no entry points: there, ``mrt_mitsuba.register()`` does the same.

Source: https://github.com/mitsuba-renderer/mitsuba3/pull/1943
"""

from . import register

register()
