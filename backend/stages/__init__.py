"""One file per arrow of the data flow. Stages never import each other; only the pipeline knows their order."""
