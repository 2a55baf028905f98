"""`lang3dxl view`: a trained scene in the viewer, on this machine only."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import tyro

from lang3dxl_ns.common.checks import check_address


@dataclass(kw_only=True)
class View:
    """Explore and query a trained scene in a browser on this machine.

    The browser draws the Gaussians (WebGL) at its own frame rate, whatever this machine can render; a prompt
    sends colors. No code in config.yml is run. (`ns-viewer` shows server renderings in nerfstudio's
    viewer; it is open to the whole network by default, and trusts the file.)
    """

    run: tyro.conf.Positional[Path | None] = None
    """Folder of the run, or its config.yml (default: the newest under outputs/)."""
    text: str = ""
    """Initial prompt."""
    host: str = "127.0.0.1"
    """Address to serve at; 0.0.0.0 opens it to the network, with the token shown in the terminal."""
    port: int | None = None
    """Port to serve at; by default a free one from 7007 on."""
    share: bool = False
    """Make the viewer public through viser's share tunnel, to anyone with the token."""

    def main(self) -> None:
        from lang3dxl_ns.plugin.open_run import open_run
        from lang3dxl_ns.plugin.pipeline import QUERY_VARIABLE

        check_address(self.host, self.port)
        if self.text:
            os.environ[QUERY_VARIABLE] = self.text
        config, pipeline, _ = open_run(self.run)
        viewer = replace(
            config.viewer,
            websocket_host=self.host,
            websocket_port=self.port,
            make_share_url=self.share,
        )
        from lang3dxl_ns.plugin.viewer.browser import BrowserViewer

        BrowserViewer(pipeline, viewer, config.get_base_dir()).serve()
