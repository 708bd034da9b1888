/* A target with a fault that only an engine finds that goes by the code that inputs reach. */
#include <stdlib.h>

#include "engine.h"

int LLVMFuzzerInitialize(int *argument_count, char ***arguments)
{
    (void)argument_count;
    (void)arguments;
    return 0;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t length)
{
    if (length > 3 && data[0] == 'v')
        if (data[1] == 'i')
            if (data[2] == 'b')
                if (data[3] == '\r')
                    abort();
    return 0;
}
