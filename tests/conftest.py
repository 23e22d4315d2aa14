"""Fixtures shared by all tiers of tests."""

from __future__ import annotations
