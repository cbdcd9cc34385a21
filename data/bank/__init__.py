"""Banks of model images: the file and how it is built."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.data.bank.bank_file import Bank, BankGroup, open_bank
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = ["Bank", "BankGroup", "open_bank"]
