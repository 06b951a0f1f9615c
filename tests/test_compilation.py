# SPDX-License-Identifier: Apache-2.0
"""How functions are compiled."""

from typing import Any

import jax
import pytest

from jaxskills import compilation


@pytest.mark.parametrize(
    ("flags", "left"),
    [
        ("", {"xla_cpu_use_fusion_emitters", "xla_backend_optimization_level"}),
        ("--xla_backend_optimization_level=0", {"xla_cpu_use_fusion_emitters"}),
    ],
)
def test_flags_of_the_user_stay(flags: str, left: set[str], monkeypatch: pytest.MonkeyPatch):
    asked: dict[str, Any] = {}
    monkeypatch.setenv("XLA_FLAGS", flags)
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    monkeypatch.setattr(jax, "jit", lambda function, **options: asked.update(options))
    compilation.jit(lambda x: x)
    assert set(asked["compiler_options"]) == left
