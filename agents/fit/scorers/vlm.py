"""A vision-language model as a judge: how much likelier one of two answers is, given frames of an episode.

The model sees the frames as images, a question, and two contrasting descriptions, each with the answer that stands for
it. Both answers are teacher-forced, whole and with the token that ends a turn, and the difference of their
log-probabilities is averaged over both orders of the descriptions, because models prefer what comes first. So swapped
answers negate the score exactly.

Any image-text model that ``AutoModelForImageTextToText`` of transformers loads works, from a folder on this machine.
Nothing is downloaded, no code of the folder runs, and parameters are read from safetensors only.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import BaseModel, Field, model_validator

from piavatar_envs.config import FROZEN, ConfigError
from piavatar_envs.core.extras import missing
from piavatar_envs.core.reading import UNREADABLE

if TYPE_CHECKING:
    from agents.fit.rollout import Episode, World

#: Files that a folder must have; parameters are in one file or in several that an index names.
_CONFIG, _WEIGHTS = "config.json", "*.safetensors"
_FETCH = "huggingface-cli download Qwen/Qwen2.5-VL-7B-Instruct --local-dir"


class Config(BaseModel):
    """Settings of the scorer."""

    model_config = FROZEN

    path: Path | None = Field(None, strict=False, description="folder of the model, with config.json and safetensors")
    question: str = Field(
        "These are frames of a video, in the order of time. Which description is right?",
        description="question, before the two descriptions",
    )
    prompts: tuple[str, str] = Field(
        ("the ball is heavy", "the ball is light"), description="two contrasting descriptions"
    )
    answers: tuple[str, str] = Field(
        ("heavy", "light"), description="answers that stand for them, a word or a few each"
    )
    frames: int = Field(8, ge=1, le=64, description="frames of an episode that the model sees, evenly spaced in time")
    dtype: Literal["float32", "bfloat16", "float16"] = Field("float32", description="type of the model's parameters")
    device: str = Field("cpu", description="torch device of the model, as cuda:0")

    @model_validator(mode="after")
    def _check_answers(self) -> Config:
        """Refuse answers or descriptions that are equal or empty."""
        for name in ("prompts", "answers"):
            first, second = getattr(self, name)
            if not first.strip() or not second.strip() or first == second:
                raise ConfigError(f"{name}={[first, second]} must be two different texts")
        return self


def check_model(path: Path | None) -> Path:
    """Return the folder of a model.

    Raises:
        ConfigError: it is not given, or is not a model that is read without running or unpickling anything.
    """
    if path is None:
        raise ConfigError(f"scorers.vlm.path is missing; fetch a model and give its folder: {_FETCH} FOLDER")
    if not (path / _CONFIG).is_file() or not any(path.glob(_WEIGHTS)):
        raise ConfigError(
            f"scorers.vlm.path={str(path)!r} must be a folder with {_CONFIG} and {_WEIGHTS}; nothing is downloaded or "
            f"unpickled here; fetch a model with: {_FETCH} {path}"
        )
    return path


class VlmScorer:
    """Score of an episode by a vision-language model: log p(first answer) - log p(second answer)."""

    Config = Config
    direction = "maximize"
    unit = "nat"
    readings = ()

    def __init__(self, config: Config) -> None:
        """Load the model.

        Raises:
            ConfigError: the folder holds no such model.
            MissingExtra: transformers or Pillow is not installed.
        """
        folder = check_model(config.path)
        self.config, self.pictures = config, config.frames
        # read when transformers is imported: no request is made for a file that a folder lacks
        os.environ["HF_HUB_OFFLINE"] = os.environ["TRANSFORMERS_OFFLINE"] = "1"
        try:
            import torch
            import transformers
            from PIL import Image
            from safetensors import SafetensorError
        except ImportError as error:
            raise missing("the scorer vlm", error.name or "transformers", "vlm,render") from None
        transformers.logging.set_verbosity_error()
        transformers.logging.disable_progress_bar()
        local = {"local_files_only": True, "trust_remote_code": False}
        try:
            self._tokens = transformers.AutoTokenizer.from_pretrained(folder, **local)
            self._images = transformers.AutoImageProcessor.from_pretrained(folder, **local)
            self._model = transformers.AutoModelForImageTextToText.from_pretrained(
                folder, dtype=getattr(torch, config.dtype), use_safetensors=True, **local
            )
        except (*UNREADABLE, ImportError, SafetensorError) as error:
            raise ConfigError(f"scorers.vlm.path={str(folder)!r}: {' '.join(str(error).split())[:300]}") from None
        self._model.eval().to(config.device)
        self._torch, self._image = torch, Image.fromarray
        self._placeholder = self._tokens.decode([self._model.config.image_token_id])
        self._end = self._tokens.eos_token_id

    def connect(self, world: World) -> None:
        """Accept any world."""

    def score(self, episode: Episode) -> float:
        """Return the score of an episode's frames [nat]."""
        return self.judge(episode.pictures)

    def judge(self, frames: np.ndarray) -> float:
        """Return the difference of the answers' log-probabilities, averaged over both orders [nat].

        Args:
            frames: shape ``(count, height, width, 3)`` uint8.
        """
        pixels = self._images(images=[self._image(frame) for frame in frames], return_tensors="pt")
        pixels = {name: values.to(self.config.device) for name, values in pixels.items()}
        differences = []
        for order in ((0, 1), (1, 0)):
            prompt = self._prompt(order, pixels, len(frames))
            first, second = (self._log_probability(prompt, answer, pixels) for answer in self.config.answers)
            differences.append(first - second)
        return 0.5 * (differences[0] + differences[1])

    def _prompt(self, order: tuple[int, int], pixels: dict[str, Any], count: int) -> list[int]:
        """Return the tokens of the user's turn: images, question, and descriptions in an order."""
        described = [f"- {self.config.answers[i]}: {self.config.prompts[i]}" for i in order]
        choice = " or ".join(self.config.answers[i] for i in order)
        text = "\n".join([self.config.question, *described, f"Answer with {choice}, and nothing else."])
        content = [*({"type": "image"} for _ in range(count)), {"type": "text", "text": text}]
        turn = [{"role": "user", "content": content}]
        templated = self._tokens.apply_chat_template(turn, add_generation_prompt=True, tokenize=False)
        return self._tokens(self._with_images(templated, pixels), add_special_tokens=False).input_ids

    def _with_images(self, text: str, pixels: dict[str, Any]) -> str:
        """Repeat each placeholder of an image as often as the image has tokens, where the model's grid says so."""
        if "image_grid_thw" not in pixels:
            return text
        counts = pixels["image_grid_thw"].prod(1) // self._images.merge_size**2
        first, *parts = text.split(self._placeholder)
        return first + "".join(self._placeholder * int(count) + part for count, part in zip(counts, parts, strict=True))

    def _log_probability(self, prompt: list[int], answer: str, pixels: dict[str, Any]) -> float:
        """Return the log-probability of a whole answer and the end of its turn after a prompt [nat]."""
        torch = self._torch
        tokens = [*self._tokens(answer, add_special_tokens=False).input_ids, self._end]
        ids = torch.tensor([[*prompt, *tokens]], device=self.config.device)
        more = dict(pixels)
        if "image_grid_thw" in pixels:  # kinds of tokens, by which the model places images in time and space
            more["mm_token_type_ids"] = (ids == self._model.config.image_token_id).int()
        with torch.inference_mode():
            logits = self._model(input_ids=ids, attention_mask=torch.ones_like(ids), **more).logits[0]
        steps = logits[-len(tokens) - 1 : -1].float().log_softmax(-1)
        return float(steps.gather(1, ids[0, -len(tokens) :, None]).sum())


SCORER = VlmScorer
