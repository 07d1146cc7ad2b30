"""Write ``docs/envs/*.md``, a page for every environment and an index, from the code; or compare them with it.

make docs                                     # the text: seconds
make docs CHECK=1                             # fail where the committed text differs from the code
python -m scripts.env_pages --pictures        # the pictures, too: each needs a rollout at the default resolution
python -m scripts.env_pages --pictures --only reach
"""

from __future__ import annotations

import sys
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated

import tyro

from piavatar_envs import doctor
from scripts.pages.entries import ROOT, entries, gather
from scripts.pages.gaps import gaps
from scripts.pages.index import index_page
from scripts.pages.pictures import draw
from scripts.pages.text import FOLDER, PICTURES, entry_page

#: Bytes of a picture; a frame without anything in it packs into a fraction of the least.
PICTURE_BYTES = (20_000, 400_000)


def main(
    check: Annotated[bool, tyro.conf.arg(help="write nothing; fail where the pages differ from the code")] = False,
    pictures: Annotated[bool, tyro.conf.arg(help="draw the pictures, too")] = False,
    only: Annotated[tuple[str, ...], tyro.conf.arg(help="names of the pages to write; all if not given")] = (),
    device: Annotated[str, tyro.conf.arg(help="where to simulate the pictures: cpu, cuda, ...")] = "cpu",
) -> int:
    """Write or check the pages; the exit status is 1 if a task lacks documentation or a checked page differs.

    Args:
        check: compare the pages with the code and write nothing.
        pictures: draw the pictures, too.
        only: names of the pages to write.
        device: where to simulate the pictures.

    Raises:
        ValueError: there is no page of that name, or a check is asked to draw or to leave pages out.
    """
    doctor.quiet_warp()
    known = entries()
    unknown = set(only) - {entry.name for entry in known}
    if unknown:
        raise ValueError(f"no page {min(unknown)!r}; there are {', '.join(entry.name for entry in known)}")
    if check and (pictures or only):
        raise ValueError("--check compares all pages and draws none; leave out --pictures and --only")
    found, missing = [], []
    for entry in known:
        env = entry.make(fidelity="tiny")
        found.append((entry, gather(entry, env)))
        env.close()
        missing += [f"{entry.title}: {gap}" for gap in gaps(*found[-1])]
    pages = {entry.name: entry_page(entry, facts) for entry, facts in found} | {"README": index_page(found)}
    if check:
        missing += differences(FOLDER, pages) + picture_faults(PICTURES, [entry.name for entry in known])
    else:
        FOLDER.mkdir(parents=True, exist_ok=True)
        for name in only or pages:
            (FOLDER / f"{name}.md").write_text(pages[name], encoding="utf-8")
            print((FOLDER / f"{name}.md").relative_to(ROOT))
        for entry in known if pictures else ():
            if not only or entry.name in only:
                draw(entry, PICTURES / f"{entry.name}.png", device)
                print((PICTURES / f"{entry.name}.png").relative_to(ROOT))
    for line in missing:
        print(line, file=sys.stderr)
    return 1 if missing else 0


def differences(folder: Path, pages: Mapping[str, str]) -> list[str]:
    """Return a line for every page of ``folder`` that is missing, left over, or not the text in ``pages``."""
    found = {path.stem: path.read_text(encoding="utf-8") for path in folder.glob("*.md")}
    remedy = "run `make docs` and commit it"
    return [
        *(f"{folder / name}.md is missing; {remedy}" for name in pages if name not in found),
        *(
            f"{folder / name}.md is out of date; {remedy}"
            for name, text in pages.items()
            if found.get(name, text) != text
        ),
        *(f"{folder / name}.md belongs to no environment; delete it" for name in sorted(found.keys() - pages.keys())),
    ]


def picture_faults(folder: Path, names: Collection[str]) -> list[str]:
    """Return a line for every picture of ``folder`` that is missing, left over, or of an unlikely size."""
    sizes = {path.stem: path.stat().st_size for path in folder.glob("*")}
    least, most = PICTURE_BYTES
    return [
        *(
            f"{folder / name}.png is missing or not of {least} to {most} bytes; "
            f"run `python -m scripts.env_pages --pictures --only {name}`"
            for name in names
            if not least < sizes.get(name, 0) < most
        ),
        *(f"{folder / name}.png belongs to no environment; delete it" for name in sorted(sizes.keys() - {*names})),
    ]


if __name__ == "__main__":
    try:
        sys.exit(tyro.cli(main))
    except (ValueError, ImportError) as error:
        sys.exit(f"error: {error}")
