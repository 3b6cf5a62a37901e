"""What can go wrong with a bag, as one tree of exceptions."""


class BagError(RuntimeError):
    """Root of everything this package raises on purpose."""


class BagExistsError(BagError):
    """The bag to be written exists already; nothing is ever overwritten."""


class BagFormatError(BagError):
    """What is to be read is no bag, or none that can be read here."""


class BagTypeError(BagError):
    """A message type is unknown, or a message does not fit its type."""


class BagWriteError(BagError):
    """The bag cannot be written: a wrong call, or the disk refused."""
