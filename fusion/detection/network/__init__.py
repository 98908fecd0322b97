"""The two-stage detector as flax modules."""

__all__: list[str] = []
