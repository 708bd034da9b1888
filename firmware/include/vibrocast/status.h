/* Results of the functions of the core. */
#ifndef VIBROCAST_STATUS_H
#define VIBROCAST_STATUS_H

/* cffi: begin */
enum vc_status {
    VC_OK = 0,
    VC_CONCEALED = 1,          /* the packet could not be played: its time was filled by a fade or by silence */
    VC_BAD_CONFIGURATION = -1, /* configuration bytes or channel count outside the layout */
    VC_BAD_TABLES = -2,        /* tables of another size */
    VC_BAD_PACKET = -3,        /* a malformed packet; nothing was played */
    VC_PACKET_TOO_LARGE = -4,  /* the coded packet does not fit the buffer; the encoder must be initialised again */
    VC_HOST_ONLY = -5          /* a stream that controllers do not decode */
};
/* cffi: end */

#endif
