from liir_common.cli import main

main()
