"""The camera measured: flat fields, the data sheet, and fits of a sensor to measured frames."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.render.bench.data_sheet.characterise import characterise
    from phasemark.render.bench.data_sheet.results import Characterisation, Comparison, SheetQuantity
    from phasemark.render.bench.fit.fit_sensor import fit_sensor
    from phasemark.render.bench.fit.fitted_sensor import FittedField, SensorFit
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = ["Characterisation", "Comparison", "FittedField", "SensorFit", "SheetQuantity", "characterise", "fit_sensor"]
