"""Stand-in for torch, which stable-baselines3 imports and its vector environments do not use."""

from __future__ import annotations

from any_name import stand_in

__version__ = "0"
__path__: list[str] = []
__getattr__ = stand_in(__name__)
