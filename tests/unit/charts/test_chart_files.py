"""The generated parts of the Helm chart match the code."""

from __future__ import annotations

from charts.generate import FILES, chart_files


def test_the_charts_crds_and_rights_are_those_of_the_code() -> None:
    found = {str(path.relative_to(FILES)): path.read_text() for path in FILES.rglob("crds/*.yaml")}
    found["rights.yaml"] = (FILES / "rights.yaml").read_text()
    assert found == chart_files(), "the chart is stale: run `make crds`"
