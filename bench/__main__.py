import sys

from bench.kernels import main

main(sys.argv[1:])
