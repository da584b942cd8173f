using System;
using System.Threading;

namespace Ultragray
{
    /// <summary>The pixels of one pose, and the facts of them. It is its holder's until they take the next one into it.</summary>
    public sealed class Frame
    {
        internal byte[] Buffer = new byte[0];
        internal int Begin;

        /// <summary>The settings as used, the pose as used, how far to trust the frame, what it cost.</summary>
        public FrameHeader Header { get; internal set; } = new FrameHeader();

        public int Height => (int)Header.Height;

        public int Width => (int)Header.Width;

        /// <summary>The similarity (MS-SSIM) that a real frame of this pose is expected to have, 0 to 1; null: not known.</summary>
        public double? Confidence => Header.Extrapolation == null ? null : Header.Extrapolation.Confidence;

        /// <summary>The encoded bytes: raw pixels are outputs one after another, each [height, width] row by row.</summary>
        public ArraySegment<byte> Data => new ArraySegment<byte>(Buffer, Begin, Count);

        internal int Count { get; set; }

        /// <summary>
        /// The raw pixels of one output. Throws ArgumentException for an output that was not asked for, and for pixels in the
        /// form of an image file.
        /// </summary>
        public ArraySegment<byte> Pixels(string output = "bmode")
        {
            int at = Begin;
            foreach (string one in Header.Outputs)
            {
                int size = Height * Width * (one == "labels" && View != null ? 1 : PixelBytes);
                if (one == output) return new ArraySegment<byte>(Buffer, at, size);
                at += size;
            }
            throw new ArgumentException("the frame has " + string.Join(", ", Header.Outputs) + ", not " + output);
        }

        int PixelBytes
        {
            get
            {
                switch (Header.Encoding)
                {
                    case PixelEncoding.Uint8: return 1;
                    case PixelEncoding.Float16: return 2;
                    case PixelEncoding.Float32: return 4;
                    default: throw new ArgumentException("pixels as " + Header.Encoding + " must be decoded: Data holds them");
                }
            }
        }

        /// <summary>The settings that libultragray prepared for it; null of a service.</summary>
        internal object View { get; set; }

        internal void SetPose(double[] matrix)
        {
            if (Header.Pose == null) Header.Pose = new[] { new double[4], new double[4], new double[4], new double[4] };
            for (int i = 0; i < 16; i++) Header.Pose[i / 4][i % 4] = matrix[i];
        }

        internal void Reserve(int count)
        {
            if (Buffer.Length < count) Array.Resize(ref Buffer, Math.Max(count, 2 * Buffer.Length));
        }
    }

    /// <summary>
    /// Frames of a scene for the poses that are asked for, the newest first: a pose that is asked for takes the place of one that
    /// waits. No call blocks, and all may be made on any thread.
    /// </summary>
    public interface IFrameSource : IDisposable
    {
        /// <summary>Of frames from the next pose on; null: as the scene has them. Set it anew to change them.</summary>
        RenderSettings Settings { set; }

        /// <summary>What is wrong, in a sentence for a person; null while frames come.</summary>
        string Problem { get; }

        void Ask(ProbePose pose);

        /// <summary>
        /// Whether a frame has come since the last one was taken: then the newest is in `frame`, and what was there (null at first) is
        /// filled anew later.
        /// </summary>
        bool Take(ref Frame frame);
    }

    /// <summary>
    /// The newest pose on its way to whoever renders it, and the newest frame on its way back. Locked by itself, and pulsed where
    /// there is something to do.
    /// </summary>
    sealed class Exchange
    {
        Frame newest = new Frame();
        ProbePose pose;
        RenderSettings settings;
        string problem;

        /// <summary>Number of the newest pose; 0: none was asked for.</summary>
        internal long Asked { get; private set; }

        /// <summary>Number of the newest pose that has its frame, or was refused.</summary>
        internal long Answered { get; private set; }

        /// <summary>Number of the pose from which the settings are as they are.</summary>
        internal long SetSince { get; private set; } = 1;

        /// <summary>Number of the pose whose frame was taken last.</summary>
        internal long Taken { get; private set; }

        internal bool IsFresh { get; private set; }

        internal ProbePose Pose => pose;

        internal RenderSettings Settings => settings;

        internal string Problem
        {
            get
            {
                lock (this) return problem;
            }
        }

        internal void Ask(ProbePose newer)
        {
            lock (this)
            {
                pose = newer;
                Asked++;
                Monitor.PulseAll(this);
            }
        }

        internal void Set(RenderSettings newer)
        {
            lock (this)
            {
                settings = newer;
                Renew();
            }
        }

        /// <summary>Frames from here on are others, for other settings or a finer scene: the newest pose is asked for again.</summary>
        internal void Renew()
        {
            lock (this)
            {
                SetSince = Asked + 1;
                if (Asked > 0) Asked++;
                Monitor.PulseAll(this);
            }
        }

        /// <summary>Tells what is wrong, null: nothing, of a pose by its number, else by 0.</summary>
        internal void Tell(long number, string sentence)
        {
            lock (this)
            {
                Answered = Math.Max(Answered, number);
                problem = sentence;
            }
        }

        /// <summary>Puts a frame up to be taken, and another one to fill in its place.</summary>
        internal void Publish(long number, ref Frame frame)
        {
            lock (this)
            {
                Swap(ref frame);
                IsFresh = true;
                Answered = Math.Max(Answered, number);
                problem = null;
            }
        }

        internal bool Take(ref Frame frame)
        {
            lock (this)
            {
                if (!IsFresh) return false;
                if (frame == null) frame = new Frame();
                Swap(ref frame);
                IsFresh = false;
                Taken = frame.Header.Sequence;
                Monitor.PulseAll(this);
                return true;
            }
        }

        internal void Pulse()
        {
            lock (this) Monitor.PulseAll(this);
        }

        void Swap(ref Frame frame)
        {
            var other = newest;
            newest = frame;
            frame = other;
        }
    }
}
