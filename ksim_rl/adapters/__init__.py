"""Shows our envs as envs of other libraries, one module each, which alone imports the library."""
