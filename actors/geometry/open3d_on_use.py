"""Load Open3D when it is first needed, and say what to install when it cannot be.

It takes two seconds and 100 MB, so nothing imports it at the top of a module.  On a bare machine
its shared library asks for others that no Python package brings: the error names their Debian
package.
"""

from __future__ import annotations

import re
from typing import Any, Final

DEBIAN_PACKAGES: Final = {
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libudev.so.1": "libudev1",
    "libidn2.so.0": "libidn2-0",
    "libgomp.so.1": "libgomp1",
}


def open3d() -> Any:  # its stubs contradict its behaviour, so the module is handed out untyped
    """Return the module `open3d`.

    Raises:
        ImportError: Not installed, or a shared library of the system is missing.
    """
    try:
        import open3d as module
    except ImportError as error:
        missing = re.search(r"(lib[\w.+-]+\.so[.\d]*)", str(error))
        if missing is None:
            remedy = "install it: pip install -e '.[actors]' in the clone of enact-dist"
        else:
            package = DEBIAN_PACKAGES.get(missing[1], f"the package that holds {missing[1]}")
            remedy = f"sudo apt-get install -y {package}"
        raise ImportError(f"Open3D cannot be loaded ({error}); {remedy}", name="open3d") from error
    return module
