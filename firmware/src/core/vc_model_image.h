/* Model images, read in place; docs/reference/protocol.md, "Model image". */
#ifndef VIBROCAST_MODEL_IMAGE_H
#define VIBROCAST_MODEL_IMAGE_H

#include "vc_fields.h"
#include "vibrocast/protocol.h"
#include "vc_rejection.h"

/* cffi: begin */
/* Pieces point into the bytes that were read. Texts are UTF-8. */
typedef struct {
    uint8_t codec; /* identifier */
    vc_piece name, version;
    vc_piece hardware;        /* the only hardware id that it may run on; empty: any */
    vc_piece payload;         /* tables for the codec's decoder */
    uint32_t number;          /* of the release, which the signature covers; 0 in an unsigned image */
    const uint8_t *signature; /* 64 bytes, not yet checked; NULL in an unsigned image */
} vc_model_image;

/* Returns the bytes of an image without its number and signature: `length` if it is unsigned, or no image. Any bytes
 * are safe. */
size_t vc_model_image_unsigned_bytes(const uint8_t *data, size_t length);

/* Reads `data`, all of it, as an image. Returns 0, or the rejection's code, VC_IMAGE_REJECTED. Any bytes are safe.
 */
int vc_model_image_read(vc_model_image *image, const uint8_t *data, size_t length, vc_rejection *rejection);
/* cffi: end */

#endif
