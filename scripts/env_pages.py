"""Write ``docs/envs/*.md``, a page for every environment and an index, from the code.

make docs                                     # the text: seconds
python -m scripts.env_pages --pictures        # the pictures, too: each needs a rollout at the default resolution
python -m scripts.env_pages --pictures --only reach
"""

from __future__ import annotations

import sys
from typing import Annotated

import tyro

from piavatar_envs import doctor
from scripts.pages.entries import ROOT, entries, gather
from scripts.pages.gaps import gaps
from scripts.pages.index import index_page
from scripts.pages.pictures import draw
from scripts.pages.text import FOLDER, PICTURES, entry_page


def main(
    pictures: Annotated[bool, tyro.conf.arg(help="draw the pictures, too")] = False,
    only: Annotated[tuple[str, ...], tyro.conf.arg(help="names of the pages to write; all if not given")] = (),
    device: Annotated[str, tyro.conf.arg(help="where to simulate the pictures: cpu, cuda, ...")] = "cpu",
) -> int:
    """Write the pages; the exit status is 1 if a task lacks documentation.

    Args:
        pictures: draw the pictures, too.
        only: names of the pages to write.
        device: where to simulate the pictures.

    Raises:
        ValueError: there is no page of that name.
    """
    doctor.quiet_warp()
    known = entries()
    unknown = set(only) - {entry.name for entry in known}
    if unknown:
        raise ValueError(f"no page {min(unknown)!r}; there are {', '.join(entry.name for entry in known)}")
    FOLDER.mkdir(parents=True, exist_ok=True)
    found, missing = [], []
    for entry in known:
        env = entry.make(fidelity="tiny")
        facts = gather(entry, env)
        env.close()
        found.append((entry, facts))
        if only and entry.name not in only:
            continue
        path = FOLDER / f"{entry.name}.md"
        path.write_text(entry_page(entry, facts), encoding="utf-8")
        print(path.relative_to(ROOT))
        missing += [f"{entry.title}: {gap}" for gap in gaps(entry, facts)]
        if pictures:
            draw(entry, PICTURES / f"{entry.name}.png", device)
            print((PICTURES / f"{entry.name}.png").relative_to(ROOT))
    (FOLDER / "README.md").write_text(index_page(found), encoding="utf-8")
    for line in missing:
        print(line, file=sys.stderr)
    return 1 if missing else 0


if __name__ == "__main__":
    try:
        sys.exit(tyro.cli(main))
    except (ValueError, ImportError) as error:
        sys.exit(f"error: {error}")
