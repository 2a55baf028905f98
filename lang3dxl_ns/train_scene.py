"""`train`: turn photos into a scene from Python."""

from __future__ import annotations

from pathlib import Path

from lang3dxl_ns.open_scene import load_scene
from lang3dxl_ns.query.scene import Scene


def train(
    data: str | Path,
    out: str | Path = "outputs",
    *,
    iterations: int | None = None,
    clip: str | None = None,
    dense: str | None = None,
    scale: float | None = None,
) -> Scene:
    """Train a scene from photos, as `ns-train lang3dxl` does without a viewer, and return it.

    Args:
        data: folder of photos, with or without a COLMAP model or transforms.json, or a video.
        out: folder for the run, in which NAME.scene is written.
        iterations: training steps; by default 30,000 on a GPU and 3,000 without one.
        clip: the CLIP that provides the language features: "builtin", a Hugging Face name, a folder, or
            "none" to train colors only. The default is the one of `ns-train lang3dxl`.
        dense: dense encoder, with the same choices.
        scale: size of the photos that colors are trained on, as a fraction of the files' size.

    Raises:
        UserError: the photos cannot be used, or training was interrupted.
    """
    from lang3dxl_ns.common.console import silence_libraries
    from lang3dxl_ns.common.errors import UserError

    silence_libraries()
    from lang3dxl_ns.methods import lang3dxl, run_config

    usual = lang3dxl.config.pipeline.datamanager
    models = clip or usual.clip, dense or usual.dense  # type: ignore[attr-defined]
    steps = iterations or lang3dxl.config.max_num_iterations
    config = run_config(Path(data), Path(out), Path(data).stem, steps, *models)
    if scale is not None:
        config.pipeline.datamanager.camera_res_scale_factor = scale
    config.set_timestamp()
    config.save_config()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer.train()
    if trainer.interrupted:
        raise UserError(f"training was stopped; to resume: ns-train with --load-dir {trainer.checkpoint_dir}")
    return load_scene(trainer.base_dir)
