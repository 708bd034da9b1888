/* Two slots for model images in flash, and the record of their states. A power failure at any time leaves an image that
 * runs. docs/reference/protocol.md, "Model upload".
 */
#ifndef VIBROCAST_IMAGE_STORE_H
#define VIBROCAST_IMAGE_STORE_H

#include "vc_messages.h"
#include "../core/vc_model_image.h"
#include "vc_slot_record.h"

/* Changes of the record by a host from one power-on to the next; 5 or 6 make an upload, and one erases at most one slot
 * or record piece. */
#define VC_FLASH_CHANGES 2000u

/* cffi: begin */
/* Checks whether a codec can use the payload of an image. Returns 0, or the rejection's code, VC_IMAGE_REJECTED. */
typedef int (*vc_payload_check)(const void *context, uint8_t codec, const uint8_t *payload, size_t length,
                                vc_rejection *rejection);

/* `whole`: the slot's image was whole at the last check, with a signature where that is needed, and images[] describes
 * it. `erased`: nothing has been written since the slot was erased. `running`: the slot that runs, or -1. `changes`: of
 * the record since power-on. */
typedef struct {
    const vc_controller_settings *settings;
    vc_payload_check check;
    const void *check_context;
    vc_slot_record record;
    uint32_t changes;
    vc_model_image images[2];
    uint8_t whole[2], erased[2];
    uint32_t written[2]; /* bytes of an image that is being written */
    int running;
} vc_image_store;

/* Returns the number of slots: 2, or 0 without flash. */
unsigned vc_image_store_slots(const vc_image_store *store);

/* Prepares the store at power-on, and boots it. All pointers must stay valid. `flash`: NULL: there are no slots. Of the
 * settings, the store uses `actuator`, `hardware`, `public_key`, `verify_signature` and `verify_context`. With a key,
 * which needs a verifier, it takes only images that the key signed, and none with a lower number than one confirmed
 * before. */
void vc_image_store_init(vc_image_store *store, const vc_flash *flash, const vc_controller_settings *settings,
                         vc_payload_check check, const void *check_context);

/* Boots: starts a slot on trial, or reverts from one that was not confirmed. Reads both slots and may write the record.
 */
void vc_image_store_boot(vc_image_store *store);

/* The image that runs, in flash, or NULL; and the 32 bytes of its SHA-256. */
const vc_model_image *vc_image_store_running(const vc_image_store *store);
const uint8_t *vc_image_store_running_sha256(const vc_image_store *store);

/* The actuator to drive: that of the image that runs, in flash, or else that of the settings. */
const vc_actuator *vc_image_store_actuator(const vc_image_store *store);

/* Describes a slot that there is, 0 or 1, as HelloResponse does. Points into the store and the flash. */
void vc_image_store_describe(const vc_image_store *store, unsigned number, vc_image_description *description);

/* The requests. Each returns 0 and fills `report`, which points into the store, or returns the rejection's code. If the
 * flash fails, the code is VC_FLASH_FAILED: no slot has changed its state, but a slot to be erased may be empty. */

/* Prepares a slot for an image, or resumes the one that it is taking. Erases a slot. */
int vc_image_store_begin(vc_image_store *store, const vc_flash_begin *begin, vc_flash_status *report,
                         vc_rejection *rejection);
/* Programs data at the offset that is next; at any other, writes nothing. */
int vc_image_store_write(vc_image_store *store, const vc_flash_data *data, vc_flash_status *report,
                         vc_rejection *rejection);
/* Reads the slot back and checks all of it; an image that is rejected leaves the slot empty. */
int vc_image_store_verify(vc_image_store *store, unsigned number, vc_flash_status *report, vc_rejection *rejection);
/* Tests a verified slot at the next boot. */
int vc_image_store_activate(vc_image_store *store, unsigned number, vc_flash_status *report, vc_rejection *rejection);
/* Keeps the slot on trial; the one confirmed before becomes verified. */
int vc_image_store_confirm(vc_image_store *store, unsigned number, vc_flash_status *report, vc_rejection *rejection);
/* Empties a slot that neither runs nor is the one to fall back to. */
int vc_image_store_erase(vc_image_store *store, unsigned number, vc_flash_status *report, vc_rejection *rejection);
/* Finds up to `count` bytes of the image in a slot, which stay in the flash. Behind the image there are none. */
int vc_image_store_read(const vc_image_store *store, const vc_flash_read *read, vc_flash_contents *contents,
                        vc_rejection *rejection);
/* cffi: end */

#endif
