"""HTML pages and how objects show themselves in notebooks."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.data.pages.characterisation import summary_sentences, write_characterisation
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = ["summary_sentences", "write_characterisation"]
