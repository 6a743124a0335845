"""The catalog as JSON, for other programs: the scheme with the rules of each value, and the rules with their values."""

from __future__ import annotations

import json
from typing import Any

from detector.commands.catalog.catalog import Catalog, CatalogEntry
from wayside.api.scheme import SCHEME


def json_view(catalog: Catalog) -> str:
    """One object: `dimensions` and `rules`. The `rules` of a value are indices into the list of all rules."""
    place = {each: index for index, each in enumerate(catalog.entries)}
    document = {
        "dimensions": [
            {
                "name": dimension.name,
                "words": dimension.words,
                "definition": dimension.definition,
                "values": [
                    {
                        "name": value.value,
                        "words": value.words,
                        "definition": value.definition,
                        "rules": [place[each] for each in catalog.having(value)],
                    }
                    for value in dimension.values
                ],
            }
            for dimension in SCHEME
        ],
        "rules": [_rule(each) for each in catalog.entries],
    }
    return json.dumps(document, ensure_ascii=False, indent=2) + "\n"


def _rule(each: CatalogEntry) -> dict[str, Any]:
    fields = {"name": each.name, "place": each.place, "description": each.description or None}
    classification = each.classification.to_json() if each.classified else None
    return {name: value for name, value in (*fields.items(), ("classification", classification)) if value is not None}
