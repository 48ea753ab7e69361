"""The report of a build: one page that shows what a model holds and how far it can be relied upon."""
