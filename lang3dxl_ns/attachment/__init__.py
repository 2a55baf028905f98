"""Words for splats of other programs: frames, views, and learning without a trainer."""
