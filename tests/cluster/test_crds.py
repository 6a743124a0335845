"""The API server accepts Wayside's CRDs, and refuses wrong objects with messages that help."""

from __future__ import annotations

from tests.cluster.controlplane import ControlPlane


def test_the_api_server_accepts_every_crd(control_plane: ControlPlane) -> None:
    assert {file: str(error) for file, error in control_plane.refused_crds.items()} == {}
