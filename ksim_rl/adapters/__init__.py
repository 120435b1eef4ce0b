"""Our envs as the envs of other libraries: one module each, named after the library, which is imported only there."""
