"""The plan of a site as a picture in a page."""

import io
from collections.abc import Mapping
from typing import Any

from rcirl_jax.data.drawing import draw_site


def site_png(plan: Mapping[str, Any]) -> bytes:
    """Draws the plan of a recording, its longer side across, as a PNG.

    Args:
      plan: of `data.plans.plan_of`.
    """
    drawn = io.BytesIO()
    draw_site(plan).savefig(drawn, dpi=110, format="png")
    return drawn.getvalue()
