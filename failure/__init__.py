"""Rare-failure search for analog and mixed-signal circuits."""

__all__: list[str] = []
