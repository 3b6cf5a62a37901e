"""Pictures: of one run (``run``) and of a study beside the paper (``paper``, ``ratios``)."""
