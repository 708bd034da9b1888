/* Results of the functions of the core: 0 or more is success. Each function's comment names those that it returns, and
 * vc_status_text (decoder.h) gives a sentence for each. */
#ifndef VIBROCAST_STATUS_H
#define VIBROCAST_STATUS_H

/* cffi: begin */
enum vc_status {
    VC_OK = 0,
    VC_CONCEALED = 1,          /* the packet could not be played: its time was filled by a fade or by silence */
    VC_BAD_CONFIGURATION = -1, /* configuration bytes or channel count outside the layout */
    VC_BAD_TABLES = -2,        /* tables of another size */
    VC_BAD_PACKET = -3,        /* a malformed packet; nothing was played */
    VC_PACKET_TOO_LARGE = -4,  /* a coded packet does not fit its buffer; initialise an encoder again */
    VC_HOST_ONLY = -5,         /* a stream that controllers do not decode */
    VC_END = 2,                /* there is no further packet */
    VC_BAD_HEADER = -6,        /* no stream, one of another format, or a damaged header */
    VC_NO_CODEC = -7,          /* this build does not have the codec */
    VC_NEEDS_MODEL = -8,       /* the stream was coded for a model image, and it is missing or another one */
    VC_TOO_SMALL = -9,         /* memory of the caller is too small */
    VC_BAD_CHECKSUM = -10,     /* a packet is damaged, or one before it is missing */
    VC_CUT = -11,              /* the file is cut short, or has surplus packets */
    VC_NO_VERIFIER = -12,      /* a controller with a public key cannot verify signatures */
    VC_BAD_SETTINGS = -13      /* settings that no controller can have */
};
/* cffi: end */

#endif
