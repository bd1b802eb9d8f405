"""The list-driven palletizing cell, as it is shipped but for how many packages come, as processes."""

import sys
import tomllib
from pathlib import Path

from actors import running_cell
from actors.palletizing.demo.run import watch_demo

TEMPLATE = Path(running_cell.__file__).parent / "palletizing" / "cell.toml"


def shipped(packages):
    """Return the text of the shipped `cell.toml` with so many packages."""
    text = TEMPLATE.read_text("utf-8").replace("packages = 12", f"packages = {packages}")
    return text.replace("packages=12", f"packages={packages}")


def started(out, packages):
    """Return the cell on ports of this host; a context manager."""

    def configured(text, data, ports):
        config = tomllib.loads(text)
        running_cell.placed(config, data, ports)
        return running_cell.toml_of(config)

    file = out / "shipped.toml"
    file.write_text(shipped(packages))
    return running_cell.RunningCell(out, name="packages", template=file, configured=configured)


def run(out, packages):
    """Start the cell, watch it as `enact demo palletizing --cell` does; return the exit status."""
    with started(out, packages) as cell:
        return watch_demo(cell.config, out=out)


if __name__ == "__main__":
    sys.exit(run(Path(sys.argv[1]), int(sys.argv[2])))
