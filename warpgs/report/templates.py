"""HTML from templates, which escape every value that no template made."""

from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

_ENVIRONMENT = Environment(
    loader=PackageLoader("warpgs.report"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def render(name: str, **values: Any) -> Markup:
    """The content of a template with values in it, by name of its file in ``templates/``."""
    return Markup(_ENVIRONMENT.get_template(name).render(values))
