/* Model images, read where they lie; see vc_model_image.h. */
#include "vc_model_image.h"

#include "vc_crc.h"

#define CRC_BYTES 4
enum { LENGTHS_AT = sizeof VC_IMAGE_MAGIC - 1 + 2, FIXED_BYTES = LENGTHS_AT + 3 + 4 };

size_t vc_model_image_unsigned_bytes(const uint8_t *data, size_t length)
{
    const size_t unsigned_bytes = length - VC_IMAGE_SIGNED_BYTES;
    uint64_t stated;
    if (length < FIXED_BYTES + CRC_BYTES + VC_IMAGE_SIGNED_BYTES)
        return length;
    stated = (uint64_t)FIXED_BYTES + data[LENGTHS_AT] + data[LENGTHS_AT + 1] + data[LENGTHS_AT + 2] +
             vc_number(data + LENGTHS_AT + 3, 4) + CRC_BYTES;
    return stated == unsigned_bytes ? unsigned_bytes : length;
}

int vc_model_image_read(vc_model_image *image, const uint8_t *data, size_t length, vc_rejection *rejection)
{
    vc_fields fields;
    vc_piece magic, crc;
    unsigned layout, name_bytes, version_bytes, hardware_bytes;
    uint32_t payload_bytes;
    const size_t unsigned_bytes = vc_model_image_unsigned_bytes(data, length);
    image->number = 0;
    image->signature = NULL;
    if (unsigned_bytes < length) {
        image->number = (uint32_t)vc_number(data + unsigned_bytes, 4);
        image->signature = data + unsigned_bytes + 4;
        length = unsigned_bytes;
    }
    vc_fields_begin(&fields, data, length);
    magic = vc_take_piece(&fields, sizeof VC_IMAGE_MAGIC - 1);
    layout = (unsigned)vc_take_number(&fields, 1);
    image->codec = (uint8_t)vc_take_number(&fields, 1);
    name_bytes = (unsigned)vc_take_number(&fields, 1);
    version_bytes = (unsigned)vc_take_number(&fields, 1);
    hardware_bytes = (unsigned)vc_take_number(&fields, 1);
    payload_bytes = (uint32_t)vc_take_number(&fields, 4);
    if (fields.cut || !vc_same_bytes(magic.bytes, (const uint8_t *)VC_IMAGE_MAGIC, magic.length))
        return vc_reject(rejection, VC_IMAGE_REJECTED,
                         "this is no model image: flash a file that vibrocast packed as one");
    if (layout != VC_IMAGE_LAYOUT_VERSION)
        return vc_reject_numbers(rejection, VC_IMAGE_REJECTED,
                                 "a model image of layout #; this controller reads layout #", layout,
                                 VC_IMAGE_LAYOUT_VERSION);
    image->name = vc_take_piece(&fields, name_bytes);
    image->version = vc_take_piece(&fields, version_bytes);
    image->hardware = vc_take_piece(&fields, hardware_bytes);
    image->payload = vc_take_piece(&fields, payload_bytes);
    crc = vc_take_piece(&fields, CRC_BYTES);
    if (fields.cut || fields.rest.length > 0)
        return vc_reject_numbers(rejection, VC_IMAGE_REJECTED,
                                 "the model image has another length than # bytes: get the file again", length, 0);
    if (vc_crc32(data, length - CRC_BYTES, 0) != vc_number(crc.bytes, CRC_BYTES))
        return vc_reject(rejection, VC_IMAGE_REJECTED,
                         "the model image is damaged (CRC-32 differs): get the file again");
    if (!vc_is_utf8(image->name) || !vc_is_utf8(image->version) || !vc_is_utf8(image->hardware))
        return vc_reject(rejection, VC_IMAGE_REJECTED, "the model image's texts are not UTF-8: get the file again");
    return 0;
}
