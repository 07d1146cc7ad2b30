"""README and guides: their links resolve, and their Python runs."""

from __future__ import annotations

import re
import runpy
import subprocess
from pathlib import Path

import pytest

from piavatar_envs.avatar.body import sources
from piavatar_envs.avatar.motion import library
from piavatar_envs.config import ConfigError
from scripts.page_code import PAGES, ROOT, blocks

#: Code that takes minutes or a GPU, and its replacement here.
SMALLER = {
    "for _ in range(150):": "for _ in range(3):",
    "total_timesteps=50_000": "total_timesteps=16",
    ".learn(100_000)": ".learn(16)",
    "num_envs=1024": "num_envs=2",
    "num_envs=2048": "num_envs=2",
    "num_envs=4096": "num_envs=2",
    "num_envs=16": "num_envs=2",
    '"shape.pool": 64': '"shape.pool": 2',
    "num_agents=3": "num_agents=2, fidelity='tiny', episode_seconds=0.5",
    ".learn(300)": ".learn(1)",
    ".learn(6_144)": ".learn(512)",
    "runner.learn(12)": "runner.learn(1)",
    '"timesteps": 768': '"timesteps": 64',
    "NUM_ENVS, STEPS, ITERATIONS, GAMMA, LAMBDA = 8, 64, 12": "NUM_ENVS, STEPS, ITERATIONS, GAMMA, LAMBDA = 2, 61, 1",
    "total_frames=4_096": "total_frames=512",
    'device="cuda"': "device=DEVICE",
    'Path("reach").absolute()': 'FOLDER / "reach"',
    'Path("reach")': 'FOLDER / "reach"',
    'save("kick.png")': 'save(FOLDER / "kick.png")',
    'save("reach.png")': 'save(FOLDER / "reach.png")',
    'save("reach_ppo")': 'save(FOLDER / "reach_ppo")',
}


def test_links_resolve():
    others = ("CONTRIBUTING.md", "CHANGELOG.md", "*/README.md", "docs/*/*.md", "benchmarks/results/*.md")
    pages = PAGES | {page.relative_to(ROOT).as_posix(): page for pattern in others for page in ROOT.glob(pattern)}
    found = 0
    for name, page in pages.items():
        for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
            if not target.startswith(("http:", "https:", "#")):
                found += 1
                assert (page.parent / target.partition("#")[0]).exists(), f"{name} links to {target}"
    assert found > 40


def test_links_to_other_sites_are_well_formed():
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES.values())
    links = re.findall(r"https?:[^)>\s\"'`]*", text)
    assert (
        len(links) > 20
        and [link for link in links if not re.fullmatch(r"https://[\w-]+(\.[\w-]+)+(/[\w./%#~+-]*)?(?<![.,;:])", link)]
        == []
    )


@pytest.mark.parametrize("repository", ["", "me/bodies"])
def test_notebooks_open_in_colab(repository, monkeypatch):
    pytest.importorskip("sphinx", reason="needs the extra docs")
    monkeypatch.setenv("GITHUB_REPOSITORY", repository)
    conf, source = runpy.run_path(str(ROOT / "docs/conf.py")), [(ROOT / "docs/quickstart.md").read_text("utf-8")]
    conf["links_to_notebooks"](None, "quickstart", source)
    found = re.findall(r"\((https://colab\.research\.google\.com/github/\S+)\)", source[0])
    names = [notebook.name for notebook in sorted((ROOT / "notebooks").glob("*.ipynb"))]
    begin = f"https://colab.research.google.com/github/{repository}/blob/main/notebooks/"
    assert sorted(found) == ([f"{begin}{name}" for name in names] if repository else [])


def test_every_guide_is_in_the_site():
    index = (ROOT / "docs/index.md").read_text(encoding="utf-8")
    listed = [line for toctree in re.findall(r"```{toctree}\n(.*?)```", index, re.S) for line in toctree.split()]
    guides = [Path(name).relative_to("docs").with_suffix("").as_posix() for name in PAGES if name.startswith("docs/")]
    assert sorted(guide for guide in guides if guide not in listed) == ["index"]


def test_committed_results_stay_small():
    listed = subprocess.run(["git", "ls-files", "-z", "benchmarks/results"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("not a git checkout")
    sizes = {name: (ROOT / name).stat().st_size for name in listed.stdout.split("\0") if (ROOT / name).is_file()}
    assert sum(sizes.values()) < 8e6 and [name for name, size in sizes.items() if size > 1e6] == []


def test_replacements_occur_in_the_pages():
    code = "\n".join(block.code for page in PAGES.values() for block in blocks(page))
    assert [text for text in SMALLER if text not in code] == []


@pytest.mark.parametrize("name", [name for name, page in PAGES.items() if blocks(page)])
def test_python_runs(name, device, monkeypatch, tmp_path):
    """Run a page from top to bottom, with the replacements of ``SMALLER``; a block to "Save this as" is a file."""
    sb3 = pytest.importorskip("stable_baselines3", reason="needs the extra train")
    for needed in ("skrl", "rsl_rl", "pettingzoo"):
        pytest.importorskip(needed, reason="needs the extras skrl, rsl and multi")
    page = blocks(PAGES[name])
    if any("deepmimic:" in block.code for block in page):
        pytest.importorskip("pybullet", reason="needs the extra motions")
    for module, target in (("ray", "test-rllib"), ("torchrl", "clients-light")):
        if any(re.search(rf"^(import|from) {module}\b", block.code, re.M) for block in page):
            pytest.importorskip(module, reason=f"needs {module}: make {target}")
    if any("import minari" in block.code for block in page):
        pytest.skip("needs a dataset: make clients CLIENT=minari")
    monkeypatch.chdir(tmp_path if name.startswith("docs/training/") else ROOT)
    for module in (sources, library):  # what a page registers ends with it
        monkeypatch.setattr(module, "_registered", dict(module._registered))
    monkeypatch.setattr(sb3, "PPO", short_ppo(sb3.PPO))
    monkeypatch.syspath_prepend(tmp_path)
    space = {"DEVICE": device, "FOLDER": tmp_path, "__name__": name}
    for block in page:
        code = block.code
        if block.file:
            (tmp_path / block.file).write_text(code, encoding="utf-8")
        elif block.session:
            check_refusals(code, space)
        else:
            for text, small in SMALLER.items():
                code = code.replace(text, small)
            exec(compile(code, name, "exec"), space)


def short_ppo(algorithm: type) -> type:
    """Return a class of the algorithm whose default rollouts are short."""

    class ShortPPO(algorithm):
        def __init__(self, *args, n_steps: int = 8, batch_size: int = 8, **kwargs):
            super().__init__(*args, n_steps=n_steps, batch_size=batch_size, **kwargs)

    return ShortPPO


def test_training_of_an_own_task_is_a_configuration(monkeypatch, tmp_path):
    pytest.importorskip("stable_baselines3", reason="needs the extra train")
    page = PAGES["docs/tasks.md"]
    (settings,) = re.findall(r"^```yaml\n(env_id: .*?)^```", page.read_text(encoding="utf-8"), re.M | re.S)
    (tmp_path / "hands_up.yaml").write_text(settings, encoding="utf-8")
    (tmp_path / "hands_up.py").write_text(next(block.code for block in blocks(page) if block.file), encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    from agents.sb3.config import load_training

    config = load_training(tmp_path / "hands_up.yaml", {})
    assert config.env_id == "hands_up:Mine/HandsUp-v0" and config.total_steps % (8 * config.ppo.rollout_steps) == 0


def check_refusals(block: str, space: dict) -> None:
    """Check that each line after ``>>>`` is refused in the words of the line below it."""
    lines = block.splitlines()
    for typed, said in zip(lines[::2], lines[1::2], strict=True):
        with pytest.raises(ConfigError) as refused:
            exec(typed.removeprefix(">>> "), space)
        assert said == f"{type(refused.value).__name__}: {refused.value}"
