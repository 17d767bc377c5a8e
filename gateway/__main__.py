"""`python -m gateway` is `prostar-gateway`."""

from gateway.cli.main import main

main()
