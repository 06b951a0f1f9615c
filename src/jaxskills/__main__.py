# SPDX-License-Identifier: Apache-2.0
"""`python -m jaxskills` is the `jaxskills` command."""

import sys

from jaxskills.cli import main

if __name__ == "__main__":
    sys.exit(main())
