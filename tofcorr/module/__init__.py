"""`DepthCorrection`, the module that a torch user constructs, trains, fits, saves and exports."""
