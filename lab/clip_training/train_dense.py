"""Training of the small dense encoder: the CLIP's vision tower, taught to label patches of any image size.

    python -m lab.clip_training.train_dense --clip DIR --out DIR --cache DIR

The CLIP sees crops of a few patches; a dense encoder sees whole photos of thousands. So its tower continues
to learn the class of each patch, on larger images whose number of patches changes from step to step.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from torch import nn

from lab.clip_training.captions import CLASSES
from lab.clip_training.contrastive import patch_loss
from lab.clip_training.crops import augment, draw_crops, patch_labels
from lab.clip_training.small_clip import PATCH, normalize
from lab.clip_training.views import ViewFolder

_GRIDS = (6, 8, 12, 24)
"""Patches along an image's side."""
_PATCHES = 1_152
"""Patches per step."""
_SIDES = (120, 480)
"""Range of the crops' sides in pixels of a stored view."""


@dataclass(kw_only=True)
class DenseTraining:
    """Train the small dense encoder from a small CLIP."""

    clip: Path
    """The CLIP to start from."""
    out: Path
    """Folder for the encoder, in Hugging Face format."""
    cache: Path
    """Folder of the views that the CLIP was trained on."""
    steps: int = 1_500
    """Training steps."""
    threads: int = 1
    """CPU threads."""
    seed: int = 0
    """Seed of crops and weights."""

    def main(self) -> None:
        torch.set_num_threads(self.threads)
        train(self)


def train(config: DenseTraining) -> None:
    """Train as `config` says and write the encoder to `config.out`."""
    from transformers import CLIPVisionModel

    landmarks = ViewFolder(config.cache / "train").landmarks
    tower = CLIPVisionModel.from_pretrained(config.clip, local_files_only=True).train()
    torch.manual_seed(config.seed)
    head = nn.Linear(tower.config.hidden_size, len(CLASSES))
    parameters = [*tower.parameters(), *head.parameters()]
    optimizer = torch.optim.AdamW(parameters, betas=(0.9, 0.98), weight_decay=0.05)
    started, mean_loss = time.monotonic(), 0.0
    for step in range(config.steps):
        rng = np.random.default_rng((config.seed, step))
        grid = int(rng.choice(_GRIDS))
        crops = draw_crops(landmarks, _PATCHES // grid**2, 1, grid * PATCH, rng, _SIDES)
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        pixels = normalize(augment(crops.images, torch.from_numpy(crops.inside), generator))
        tokens = tower(pixel_values=pixels, interpolate_pos_encoding=True).last_hidden_state[:, 1:]
        loss = patch_loss(head(tokens), torch.from_numpy(patch_labels(crops, grid)).float())
        optimizer.param_groups[0]["lr"] = 5e-4 * min(1.0, (step + 1) / 60) * (1.02 - step / config.steps)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(parameters, 1.0)
        optimizer.step()
        mean_loss += (loss.item() - mean_loss) * max(0.02, 1 / (step + 1))
        if (step + 1) % 50 == 0:
            left = (time.monotonic() - started) / (step + 1) * (config.steps - step - 1) / 60
            print(f"step {step + 1}: mean loss {mean_loss:.3f}, {left:.0f} min left", flush=True)
    tower.save_pretrained(config.out)


if __name__ == "__main__":
    tyro.cli(DenseTraining).main()
