"""Type checking of the public API and of the Python of the pages: ``python -m scripts.check_types``.

The files of ``[tool.mypy]`` in pyproject.toml are checked, then the code of README and docs as users would save it.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

from scripts.page_code import PAGES, ROOT, page_modules

FOLDER = ROOT / "build" / "page_types"
#: Pages that need attributes which the types of ``gym.make`` lack, and a module whose kernels only Warp understands.
SKIPPED = {
    "README",
    "docs_batches",
    "docs_configuration",
    "docs_quickstart",
    "docs_scenes",
    "docs_training",
    "hands_up",
}


def main() -> int:
    """Write the modules of the pages, check everything and return the exit status."""
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir(parents=True)
    for page in PAGES.values():
        for name, code in page_modules(page).items():
            (FOLDER / f"{name}.py").write_text(code, encoding="utf-8")
    mypy = [sys.executable, "-m", "mypy"]
    pages = [str(file) for file in sorted(FOLDER.glob("*.py")) if file.stem not in SKIPPED]
    found = os.environ | {"MYPYPATH": str(FOLDER)}
    runs = (mypy, [*mypy, *pages])
    return max(subprocess.run(command, cwd=ROOT, env=found).returncode for command in runs)


if __name__ == "__main__":
    sys.exit(main())
