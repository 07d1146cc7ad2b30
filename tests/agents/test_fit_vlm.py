"""The judge by a vision-language model, a tiny random one that the tests write: its path, not its judgement."""

from __future__ import annotations

import json

import numpy as np
import pytest

pytest.importorskip("optuna", reason="needs the extra fit")
pytest.importorskip("torch", reason="needs the extra vlm")
pytest.importorskip("transformers", reason="needs the extra vlm; make test-vlm")

import torch

from agents.fit import __main__ as fit
from agents.fit.scorers.vlm import Config, VlmScorer
from piavatar_envs.config import ConfigError, load_config

SPECIAL = ["<|endoftext|>", "<|im_start|>", "<|im_end|>", "<|vision_start|>", "<|vision_end|>", "<|image_pad|>"]
TEMPLATE = (
    "{% for m in messages %}<|im_start|>{{ m.role }}\n{% for c in m.content %}{% if c.type == 'image' %}"
    "<|vision_start|><|image_pad|><|vision_end|>{% else %}{{ c.text }}{% endif %}{% endfor %}<|im_end|>\n{% endfor %}"
    "{% if add_generation_prompt %}<|im_start|>assistant\n{% endif %}"
)
WORDS = "a ball is heavy or light stiff soft belly. Answer with these are frames of a video user assistant"


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """A folder with a random model of some 200,000 parameters, its tokenizer and its image processor."""
    import transformers as t
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers, trainers

    folder = tmp_path_factory.mktemp("qwen")
    bytes_of = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer = Tokenizer(models.BPE())
    tokenizer.pre_tokenizer, tokenizer.decoder = bytes_of, decoders.ByteLevel()
    alphabet = pre_tokenizers.ByteLevel.alphabet()
    trainer = trainers.BpeTrainer(vocab_size=320, special_tokens=SPECIAL, initial_alphabet=alphabet)
    tokenizer.train_from_iterator([WORDS] * 4, trainer)
    tokens = t.PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, eos_token="<|im_end|>", pad_token="<|endoftext|>", chat_template=TEMPLATE
    )
    index = tokens.convert_tokens_to_ids
    rope = {"rope_type": "default", "rope_theta": 1e4, "mrope_section": [2, 3, 3]}
    text = {"vocab_size": len(tokens), "hidden_size": 64, "intermediate_size": 128, "num_hidden_layers": 2}
    text |= {"num_attention_heads": 4, "num_key_value_heads": 2, "max_position_embeddings": 4096}
    vision = {"depth": 2, "hidden_size": 32, "intermediate_size": 64, "num_heads": 2, "out_hidden_size": 64}
    config = t.Qwen2_5_VLConfig(
        text_config=text | {"rope_parameters": rope},
        vision_config=vision | {"fullatt_block_indexes": [1], "window_size": 112},
        image_token_id=index("<|image_pad|>"),
        vision_start_token_id=index("<|vision_start|>"),
        vision_end_token_id=index("<|vision_end|>"),
    )
    torch.manual_seed(0)
    made = t.Qwen2_5_VLForConditionalGeneration(config)
    assert 1e5 < sum(parameter.numel() for parameter in made.parameters()) < 3e5
    made.save_pretrained(folder)
    tokens.save_pretrained(folder)
    t.Qwen2VLImageProcessorPil(min_pixels=28 * 28 * 4, max_pixels=28 * 28 * 16).save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 255, (4, 64, 64, 3), dtype=np.uint8)


def judge(model, **settings) -> VlmScorer:
    return VlmScorer(load_config(Config, {"path": str(model), **settings}))


def test_swapped_answers_negate_the_score_exactly(model, frames):
    prompts, answers = ["the ball is heavy", "the ball is light"], ["heavy", "light and soft"]
    score = judge(model, prompts=prompts, answers=answers).judge(frames)
    assert score != 0.0 and np.isfinite(score)
    assert judge(model, prompts=prompts[::-1], answers=answers[::-1]).judge(frames) == -score


def test_other_frames_change_the_score(model, frames):
    scorer = judge(model)
    score = scorer.judge(frames)
    assert scorer.judge(frames) == score
    for other in (frames[::-1], np.zeros_like(frames), frames[:3]):
        assert abs(scorer.judge(other.copy()) - score) > 1e-6


def test_the_score_is_that_of_whole_answers_with_their_end(model, frames):
    # Chain rule, token by token, from the model's distribution of the next token after each prefix.
    scorer = judge(model, answers=["heavy", "light"])
    pixels = scorer._images(images=[scorer._image(frame) for frame in frames], return_tensors="pt")
    pixels = dict(pixels)
    prompt = scorer._prompt((0, 1), pixels, len(frames))
    tokens = [*scorer._tokens("heavy", add_special_tokens=False).input_ids, scorer._end]
    assert len(tokens) >= 2
    total = 0.0
    for index, token in enumerate(tokens):
        ids = torch.tensor([prompt + tokens[:index]])
        kinds = (ids == scorer._model.config.image_token_id).int()
        with torch.inference_mode():
            mask = torch.ones_like(ids)
            logits = scorer._model(input_ids=ids, attention_mask=mask, mm_token_type_ids=kinds, **pixels).logits
        total += float(logits[0, -1].log_softmax(-1)[token])
    assert scorer._log_probability(prompt, "heavy", pixels) == pytest.approx(total, abs=1e-4)


def test_what_is_no_safe_model_is_refused_with_the_command_that_fetches_one(model, tmp_path):
    with pytest.raises(ConfigError, match=r"path is missing.*huggingface-cli download"):
        VlmScorer(load_config(Config, {}))
    with pytest.raises(ConfigError, match=rf"{tmp_path}.*nothing is downloaded.*huggingface-cli download"):
        judge(tmp_path)
    for file in model.iterdir():  # parameters in a pickle are not read
        if file.suffix != ".safetensors":
            (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / "pytorch_model.bin").write_bytes(b"a pickle")
    with pytest.raises(ConfigError, match="unpickled"):
        judge(tmp_path)
    (tmp_path / "model.safetensors").write_bytes(b"damaged")
    with pytest.raises(ConfigError, match=r"scorers\.vlm\.path="):
        judge(tmp_path)


def test_the_paper_s_configuration_runs_with_a_model(model, tmp_path, device):
    settings = ["env.fidelity=tiny", "env.episode_seconds=0.25", "env.render.width=64", "env.render.height=64"]
    settings += ["trials=4", "startup=2", "scorer=vlm", f"scorers.vlm.path={model}", "scorers.vlm.frames=2"]
    fit.main(["configs/fit/ball_mass.yaml", *settings, "--out", str(tmp_path / "run"), "--device", device])
    found = json.loads((tmp_path / "run" / "results.json").read_text())
    scores = [trial["score"] for trial in found["results"]]
    assert found["unit"] == "nat" and len(scores) == 4 and len(set(scores)) > 1
