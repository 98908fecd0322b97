"""The low-dropout regulator."""

__all__: list[str] = []
