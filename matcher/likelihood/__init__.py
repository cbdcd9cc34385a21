"""Maximum likelihood: pixels compared, images modelled, views refined, background estimated."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.matcher.likelihood.background_estimate import Surroundings, estimate_surroundings
    from phasemark.matcher.likelihood.search_policy import SearchPolicy
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = ["SearchPolicy", "Surroundings", "estimate_surroundings"]
