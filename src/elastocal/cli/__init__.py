"""The command line: elastocal VERB CELL [DATA] [options]."""
