"""Segment Anything 2 with random weights: loading, prompts and tracking."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfro.masks.tracking import load_tracker, track_object
from tests.conftest import refused

SIDE, HIDDEN = 64, 128
MASK = np.zeros((30, 40), bool)
MASK[8:20, 10:30] = True


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the smallest network of this kind."""
    transformers = pytest.importorskip("transformers")
    backbone = {
        "model_type": "sam2_hiera_det_model",
        "hidden_size": 8,
        "image_size": [SIDE, SIDE],
        "blocks_per_stage": [1, 1, 1, 1],
        "embed_dim_per_stage": [8, 16, 32, 64],
        "num_attention_heads_per_stage": [1, 1, 1, 1],
        "window_size_per_stage": [4, 4, 4, 2],
        "global_attention_blocks": [],
        "window_positional_embedding_background_size": [4, 4],
    }
    vision = {
        "model_type": "sam2_vision_model",
        "backbone_config": backbone,
        "backbone_channel_list": [64, 32, 16, 8],
        "backbone_feature_sizes": [[16, 16], [8, 8], [4, 4]],
        "fpn_hidden_size": HIDDEN,
    }
    decoder = {"hidden_size": HIDDEN, "mlp_dim": 16, "iou_head_hidden_dim": 16, "num_attention_heads": 2}
    config = transformers.Sam2VideoConfig(
        image_size=SIDE,
        vision_config=vision,
        prompt_encoder_config={"hidden_size": HIDDEN, "image_size": SIDE},
        mask_decoder_config=decoder,
        memory_attention_hidden_size=HIDDEN,
        memory_attention_num_layers=1,
        memory_attention_feed_forward_hidden_size=16,
        memory_attention_rope_feat_sizes=[4, 4],
        memory_encoder_hidden_size=HIDDEN,
        mask_downsampler_embed_dim=HIDDEN,
        memory_fuser_embed_dim=HIDDEN,
        memory_fuser_intermediate_dim=16,
        memory_fuser_num_layers=1,
    )
    torch.manual_seed(0)
    model = transformers.Sam2VideoModel(config)
    with torch.no_grad():
        # The object is always there, and prompts matter to other images in spite of random weights.
        model.mask_decoder.pred_obj_score_head.proj_out.bias.fill_(100.0)
        for name, parameter in model.named_parameters():
            parts = "memory_attention", "memory_encoder", "object_pointer_proj", "mask_downsample"
            if name.startswith(parts) and "norm" not in name:
                parameter.mul_(5)
    folder = tmp_path_factory.mktemp("sam2")
    model.save_pretrained(folder)
    return folder


def test_all_images_without_a_known_mask_are_segmented_and_depend_on_the_prompts(network: Path) -> None:
    model, generator, steps = load_tracker(network), np.random.default_rng(0), []
    images = [generator.integers(0, 256, (30, 40, 3), np.uint8) for _ in range(6)]
    first = track_object(model, images, {2: MASK}, {4: [10, 8, 30, 20]}, lambda: steps.append(1))
    assert sorted(first) == [0, 1, 3, 4, 5]
    assert len(steps) == 4
    assert {mask.shape for mask in first.values()} == {(30, 40)}
    again = track_object(model, images, {2: MASK}, {4: [10, 8, 30, 20]})
    assert all(np.array_equal(mask, again[view]) for view, mask in first.items())
    for masks, boxes in (({2: ~MASK}, {4: [10, 8, 30, 20]}), ({2: MASK}, {4: [0, 0, 5, 5]})):
        other = track_object(model, images, masks, boxes)
        assert all((first[view] != other[view]).any() for view in (0, 1, 3, 5))


def test_folders_without_a_network_are_refused_in_one_line(network: Path, tmp_path: Path) -> None:
    refused(r"has no config\.json; give a folder", load_tracker, tmp_path)
    (tmp_path / "config.json").write_bytes((network / "config.json").read_bytes())
    refused("cannot be loaded", load_tracker, tmp_path)
    (tmp_path / "model.safetensors").write_bytes((network / "model.safetensors").read_bytes()[:5000])
    refused("cannot be loaded", load_tracker, tmp_path)


def test_missing_package_is_named_with_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    refused(r"pip install 'nerfro\[sam2\]'", load_tracker, tmp_path)
