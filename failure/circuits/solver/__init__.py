"""The batched circuit solver: netlists, device models, modified nodal analysis, transient."""

__all__: list[str] = []
