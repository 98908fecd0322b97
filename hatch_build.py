"""The wheel's long description: the README with links that work away from the repository."""

from __future__ import annotations

import re
from pathlib import Path

from hatchling.metadata.plugin.interface import MetadataHookInterface

_LINK = re.compile(r"(!?)\[([^\]\[]*)\]\((?!https?://|#|mailto:)([^)\s]+)\)")


def absolute_links(text: str, repository: str) -> str:
    """Markdown whose relative links lead to the repository; pictures to the files themselves."""

    def full(match: re.Match[str]) -> str:
        kind = "raw" if match[1] else "blob"
        return f"{match[1]}[{match[2]}]({repository}/{kind}/main/{match[3]})"

    return _LINK.sub(full, text)


class ReadmeHook(MetadataHookInterface):
    """Sets `readme`, which `pyproject.toml` lists as dynamic."""

    def update(self, metadata: dict) -> None:
        """Read `README.md` and write its links out."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        links = metadata["urls"]["Repository"]
        metadata["readme"] = {
            "content-type": "text/markdown", "text": absolute_links(text, links),
        }  # fmt: skip
