"""A user's own simulator behind one protocol: parallel, timed, retried, and never paid twice."""

__all__: list[str] = []
