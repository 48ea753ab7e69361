"""What a build says could be wrong with its model."""

from __future__ import annotations

from typing import Any

from morph_dslam.offline.stability import stability_warnings


def build_warnings(certificate: dict[str, Any]) -> list[str]:
    """Sentences on the study's elements, the stability of its solutions, and the method of reduction."""
    of_the_method = certificate.get("reduction", {}).get("warnings", [])
    return [*certificate.get("warnings", []), *stability_warnings(certificate), *of_the_method]
