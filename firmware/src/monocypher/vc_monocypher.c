/* Compiles Monocypher, unchanged, with the names of vc_monocypher.h. */
#include "vc_monocypher.h"

#include "monocypher.inc"
