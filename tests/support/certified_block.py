"""The stretched block with a certificate: its errors are 1 % of every field, sensitivities included."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from morph_dslam.reduction.certificate import certify, compression_percent
from morph_dslam.studies.problem import Snapshot
from tests.support.stretched_block import stretched_block_model

FAILED = {"coordinates": [0.1, -0.004], "reason": "no equilibrium <found>"}


def certified_block_model():
    """Certified against six solves that are 1 % larger than the model says, with one sample that failed."""
    model, rng = stretched_block_model(), np.random.default_rng(0)
    solves = []
    for _ in range(6):
        mu = model.lower + (model.upper - model.lower) * rng.random(2)
        slopes = 1.01 * model.displacement.value_and_sensitivities(mu)[1]
        fields = {name: 1.01 * field.value(mu) for name, field in model.fields.items()}
        solves.append(Snapshot(mu, fields, {"displacement": slopes}))
    certificate = {
        "reduction": {"modes": 2, "singular_values": [3.0, 1.0, 1e-9]},
        **certify(model, solves),
        "compression_percent": compression_percent(model, 20),
        "samples": {"training": 14, "held_out": 6, "failed": [FAILED]},
        "stability": {"statement": "all 20 solutions are stable", "stable": 20, "unstable": 0, "unknown": 0}
        | {"unstable_samples": [], "passed": []},
    }
    provenance = {"study": "name = 'block' # <0.45>", "mesh_sha256": "ab", "versions": {"numpy": "2"}}
    return replace(model, certificate=certificate, provenance=provenance)
