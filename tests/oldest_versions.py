"""Print the lowest version that pyproject.toml allows of each package, as constraints for pip."""

import re
import tomllib
from pathlib import Path


def lowest(requirements):
    """`name==version` of each requirement `name>=version`."""
    for requirement in requirements:
        match = re.fullmatch(r"([\w.-]+)(?:\[\w+\])?>=([\w.]+)(?:,<\d+)?", requirement)
        if match:
            yield f"{match[1]}=={match[2]}"


def declared():
    """Requirements of the package and of its extras, the development tools apart."""
    project = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    names = [name for name in extras if name not in ("all", "dev")]
    return project["dependencies"] + [r for name in names for r in extras[name]]


if __name__ == "__main__":
    print("\n".join(lowest(declared())))
