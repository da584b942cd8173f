using System;

namespace Ultragray
{
    /// <summary>
    /// A pose of the probe: the rigid transform from its frame (x lateral, y elevation, z depth, right-handed, with the origin in
    /// the middle of its face) to the scene's. Position in mm, rotation as a unit quaternion.
    /// </summary>
    public struct ProbePose : IEquatable<ProbePose>
    {
        public double X, Y, Z; // mm
        public double Qw, Qx, Qy, Qz;

        public ProbePose(double x, double y, double z, double qw, double qx, double qy, double qz)
        {
            X = x;
            Y = y;
            Z = z;
            Qw = qw;
            Qx = qx;
            Qy = qy;
            Qz = qz;
        }

        /// <summary>Of a position in mm, without a rotation.</summary>
        public static ProbePose At(double x, double y, double z) => new ProbePose(x, y, z, 1, 0, 0, 0);

        public static ProbePose Of(TrainingPose pose)
        {
            Position p = pose.PositionMm;
            Rotation q = pose.Quaternion;
            return new ProbePose(p.X, p.Y, p.Z, q.W, q.X, q.Y, q.Z);
        }

        public bool Equals(ProbePose other) =>
            X == other.X && Y == other.Y && Z == other.Z && Qw == other.Qw && Qx == other.Qx && Qy == other.Qy && Qz == other.Qz;

        /// <summary>The matrix [4, 4], row by row, of the rotation of the normalised quaternion.</summary>
        public void CopyTo(double[] matrix)
        {
            double s = 2 / (Qw * Qw + Qx * Qx + Qy * Qy + Qz * Qz);
            Row(matrix, 0, 1 - s * (Qy * Qy + Qz * Qz), s * (Qx * Qy - Qw * Qz), s * (Qx * Qz + Qw * Qy), X);
            Row(matrix, 4, s * (Qx * Qy + Qw * Qz), 1 - s * (Qx * Qx + Qz * Qz), s * (Qy * Qz - Qw * Qx), Y);
            Row(matrix, 8, s * (Qx * Qz - Qw * Qy), s * (Qy * Qz + Qw * Qx), 1 - s * (Qx * Qx + Qy * Qy), Z);
            Row(matrix, 12, 0, 0, 0, 1);
        }

        /// <summary>The member `pose` of a message.</summary>
        internal void Write(JsonWriter json)
        {
            json.Name("pose");
            json.Open('{');
            json.Name("position_mm");
            json.Open('{');
            json.Member("x", X);
            json.Member("y", Y);
            json.Member("z", Z);
            json.Close('}');
            json.Name("quaternion");
            json.Open('{');
            json.Member("w", Qw);
            json.Member("x", Qx);
            json.Member("y", Qy);
            json.Member("z", Qz);
            json.Close('}');
            json.Close('}');
        }

        static void Row(double[] matrix, int at, double a, double b, double c, double d)
        {
            matrix[at] = a;
            matrix[at + 1] = b;
            matrix[at + 2] = c;
            matrix[at + 3] = d;
        }

        /// <summary>
        /// Of a position in metres and a rotation in axes as Unity's: left-handed, x right, y up, z forward. Scenes are right-handed and in
        /// mm, so one axis changes its sign: y. A probe's lateral axis is then its red arrow and its depth the blue
        /// one. A rotation about an axis a by an angle becomes that about the mirrored axis by the opposite angle: of the
        /// quaternion, x and z change their sign. This place alone converts between the two.
        /// </summary>
        public static ProbePose FromUnity(float x, float y, float z, float qx, float qy, float qz, float qw)
        {
            return new ProbePose(1000.0 * x, -1000.0 * y, 1000.0 * z, qw, -qx, qy, -qz);
        }

        /// <summary>The inverse of FromUnity.</summary>
        public void ToUnity(out float x, out float y, out float z, out float qx, out float qy, out float qz, out float qw)
        {
            x = (float)(X / 1000);
            y = (float)(-Y / 1000);
            z = (float)(Z / 1000);
            qx = (float)-Qx;
            qy = (float)Qy;
            qz = (float)-Qz;
            qw = (float)Qw;
        }
    }
}
