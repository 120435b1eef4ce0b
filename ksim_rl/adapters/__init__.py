"""Shows our envs as those of other libraries, one module each, which alone imports the library."""
