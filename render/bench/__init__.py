"""The camera measured: flat fields, the data sheet, and fits of a sensor to measured frames."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.render.bench.data_sheet import Characterisation, Comparison, SheetQuantity, characterise
    from phasemark.render.bench.fit import FittedField, SensorFit, fit_sensor
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = ["Characterisation", "Comparison", "FittedField", "SensorFit", "SheetQuantity", "characterise", "fit_sensor"]
