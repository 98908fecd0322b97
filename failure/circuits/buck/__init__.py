"""The buck converter, at heavy and at light load."""

__all__: list[str] = []
