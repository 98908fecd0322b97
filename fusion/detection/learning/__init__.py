"""Examples, losses, training, detection and scoring."""

__all__: list[str] = []
